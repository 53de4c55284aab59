"""Hooks: every stage is seen with its arguments and result, in its thread, and results do not change."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from helpers.differences import differences
from helpers.walk_with_loop import CAMERA, CONFIG, Walk, make_pipeline, segment_red
from torch import nn

from v3d_torch.errors import ConfigError
from v3d_torch.features.features import Features
from v3d_torch.frame_result import FrameResult
from v3d_torch.geometry.depth_smoother import DepthSmoother
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.numerics_check import CheckedSLAM
from v3d_torch.runtime.stage_hooks import HookedStage
from v3d_torch.segmentation import UprightSegmenter
from v3d_torch.slam import V3DSLAM
from v3d_torch.stages.replaceable_stages import STAGES
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import FramePose, Instances, RGBDFrame

SERIAL = CONFIG.model_copy(update={"prefetch": False})
FRAMES = 8

CALLS: dict[str, tuple[int, type | tuple[type, ...]]] = {
    "segment": (2, Instances),
    "smooth_depth": (1, torch.Tensor),
    "detect_features": (2, Features),
    "compensate": (5, Features),
    "odometry": (4, CameraMotion),
    "free_space_check": (2, AppearedPixels),
    "propose_unlabelled": (3, Instances),
    "back_project_instances": (2, InstanceClouds),
    "describe_appearance": (2, torch.Tensor),
    "classify_motion": (6, FrameObjects),
    "track_camera": (6, FramePose),
    "estimate_state": (5, CameraState),
    "refine_previous": (4, type(None)),
    "mapper": (4, (Keyframe, type(None))),
}
"""Number of arguments and type of the result of each stage."""


def make_slam(system: type[V3DSLAM] = V3DSLAM) -> V3DSLAM:
    return system(CAMERA, UprightSegmenter(segment_red), SERIAL)


def test_every_stage_is_seen_with_its_arguments_and_result() -> None:
    slam, walk, seen = make_slam(), Walk(), []
    slam.register_stage_hook(None, lambda *call: seen.append(call))
    results = [slam(walk[index]) for index in range(FRAMES)]
    assert set(CALLS) == set(STAGES)
    for name, args, result in seen:
        count, kind = CALLS[name]
        assert len(args) == count and isinstance(result, kind), name
    assert any(isinstance(result, Keyframe) for name, _, result in seen if name == "mapper")
    counts = Counter(name for name, _, _ in seen)
    # For the odometry, for the pose in the map, and for each previous frame.
    assert counts.pop("compensate") == 3 * FRAMES - 1
    assert counts == dict.fromkeys(set(STAGES) - {"compensate"}, FRAMES)
    last = {name: (args, result) for name, args, result in seen}
    assert last["segment"][0][0].index == FRAMES - 1
    assert last["smooth_depth"][0][0].shape == (1, 1, 120, 160)
    assert last["free_space_check"][0][1] is True  # the motion is measured: an argument given by its name
    assert last["track_camera"][0][4] is last["odometry"][1]
    assert torch.equal(last["estimate_state"][1].T_wc, results[-1].T_wc)


@pytest.fixture(scope="module")
def plain() -> Pipeline:
    """Run without hooks and without prefetching."""
    plain = make_pipeline(prefetch=False)
    plain()
    plain.flush()
    return plain


@pytest.mark.parametrize("prefetch", [False, True])
def test_results_are_the_same_with_and_without_hooks(plain: Pipeline, prefetch: bool) -> None:
    hooked = make_pipeline(prefetch=prefetch)
    threads: dict[str, set[str]] = {name: set() for name in STAGES}
    stamps: dict[str, list[float]] = {"segment": [], "odometry": []}

    def hook(name: str, args: tuple[Any, ...], result: object) -> object:
        threads[name].add(threading.current_thread().name)
        if name == "segment":
            stamps[name].append(args[0].stamp)
        if name == "odometry":
            stamps[name].append(args[1].frame.stamp)
        return "ignored"

    hooked.slam.register_stage_hook(None, hook)
    hooked()
    hooked.flush()
    expected, found = plain.slam.state_dict(), hooked.slam.state_dict()
    assert list(differences(expected, found, "state", {})) == []
    assert torch.equal(plain.slam.poses.trajectory().T_wc, hooked.slam.poses.trajectory().T_wc)
    main = threading.current_thread().name
    preprocessing = {"segment": "segmentation_0", "smooth_depth": "features_0", "detect_features": "features_0"}
    assert threads == {name: {preprocessing.get(name, main) if prefetch else main} for name in STAGES}
    for each in stamps.values():
        assert each == sorted(each) and len(each) == len(Walk())


def test_hook_of_one_stage_and_its_removal() -> None:
    slam, walk, seen = make_slam(), Walk(), []
    first = slam.register_stage_hook("smooth_depth", lambda name, *_: seen.append(f"first {name}"))
    second = slam.register_stage_hook("smooth_depth", lambda name, *_: seen.append(f"second {name}"))
    slam(walk[0])
    assert seen == ["first smooth_depth", "second smooth_depth"]
    first.remove()
    slam(walk[1])
    assert seen[2:] == ["second smooth_depth"]
    with second:  # as torch's handles
        pass
    slam(walk[2])
    assert len(seen) == 3


@pytest.mark.parametrize("name", [None, "classify_motion"])
def test_removed_hook_no_longer_calls_object_stages_without_masks(name: str | None) -> None:
    config = SERIAL.model_copy(update={"segmentation": SERIAL.segmentation.model_copy(update={"source": "none"})})
    slam, walk, seen = V3DSLAM(CAMERA, None, config), Walk(), []
    slam(walk[0])
    handle = slam.register_stage_hook(name, lambda name, *_: seen.append(name))
    slam(walk[1])
    handle.remove()
    with_hook = len(seen)
    slam.register_stage_hook("odometry", lambda name, *_: seen.append(name))
    slam(walk[2])
    assert "classify_motion" in seen[:with_hook] and seen[with_hook:] == ["odometry"]
    calls, classify = [], slam.classify_motion
    slam.classify_motion = lambda *args: calls.append(args) or classify(*args)  # type: ignore[assignment, func-returns-value]
    assert slam._has_objects


def test_hook_that_removes_itself_sees_one_call() -> None:
    slam, walk, seen = make_slam(), Walk(), []

    def once(name: str, args: tuple[Any, ...], result: object) -> None:
        seen.append(name)
        handle.remove()

    handle = slam.register_stage_hook("odometry", once)
    slam.register_stage_hook("odometry", lambda *_: seen.append("other"))
    slam(walk[0]), slam(walk[1])
    assert seen == ["odometry", "other", "other"]


def test_stages_without_hooks_are_not_wrapped() -> None:
    slam = make_slam()
    slam.register_stage_hook("odometry", lambda *_: None)
    assert [name for name in STAGES if isinstance(getattr(slam, name), HookedStage)] == ["odometry"]


@pytest.mark.parametrize("name", ["back_end", "motion_model", "timer", "segmentation"])
def test_unknown_stage_is_an_error_with_all_names(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"^{name}: is not a stage that can have a hook; choose from seg"):
        make_slam().register_stage_hook(name, lambda *_: None)


def test_replaced_stage_keeps_its_hooks_and_its_checks() -> None:
    slam, walk, seen = make_slam(), Walk(), []
    slam.register_stage_hook(None, lambda name, args, result: seen.append((name, result)))
    config = SERIAL.depth
    slam.smooth_depth = DepthSmoother(config.kernel_size, config.sigma, config.edge_ratio)
    slam.segment = lambda frame: Instances.empty(120, 160)
    slam(walk[0])
    assert [name for name, _ in seen].count("smooth_depth") == 1 and len(dict(seen)["segment"]) == 0
    assert isinstance(slam.smooth_depth, DepthSmoother)
    slam.smooth_depth = lambda depth: depth[0]
    with pytest.raises(ConfigError, match=r"^smooth_depth is torch.float32 of shape"):
        slam(walk[1])


def test_hooks_in_debug_mode_see_the_same() -> None:
    seen: dict[type, list[tuple[str, int]]] = {V3DSLAM: [], CheckedSLAM: []}
    results: dict[type, FrameResult] = {}
    for system, calls in seen.items():
        slam, walk = make_slam(system), Walk()
        slam.register_stage_hook(None, lambda name, args, _, calls=calls: calls.append((name, len(args))))
        slam(walk[0])
        results[system] = slam(walk[1])
    assert seen[V3DSLAM] == seen[CheckedSLAM]
    assert torch.equal(results[V3DSLAM].T_wc, results[CheckedSLAM].T_wc)


class Network(nn.Module):
    """Segmenter that is a torch module, whose state is its weights."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(3))

    def forward(self, frame: RGBDFrame) -> Instances:
        return segment_red(frame)


@pytest.mark.parametrize("system", [V3DSLAM, CheckedSLAM])
def test_weights_of_a_hooked_network_are_not_state(system: type[V3DSLAM]) -> None:
    slam, frame = system(CAMERA, Network(), SERIAL), Walk()[0]
    assert slam.segment_instances(frame, None).segmenter_state is None
    slam.register_stage_hook("segment", lambda *_: None)
    assert slam.segment_instances(replace(frame), None).segmenter_state is None


@pytest.mark.parametrize("stage", ["segment", "smooth_depth"])
def test_stage_of_another_system_has_only_the_hooks_of_its_system(stage: str) -> None:
    walk, first, second = Walk(), *(V3DSLAM(CAMERA, segment_red, CONFIG) for _ in range(2))
    called: list[str] = []
    first.register_stage_hook(stage, lambda *_: called.append("first"))
    setattr(first, stage, getattr(first, stage))
    setattr(second, stage, getattr(first, stage))
    first(walk[0]), second(walk[0])
    assert called == ["first"]
    V3DSLAM(CAMERA, first.segment, CONFIG)(walk[0])
    assert called == ["first"]


@pytest.mark.parametrize("system", [V3DSLAM, CheckedSLAM])
def test_hooks_see_a_wrapper_of_a_hooked_stage_once(system: type[V3DSLAM]) -> None:
    slam, walk, seen = make_slam(system), Walk(), []
    slam.register_stage_hook(None, lambda name, args, _: seen.append(name))
    for name in ("segment", "smooth_depth"):
        setattr(slam, name, partial(getattr(slam, name)))
    slam(walk[0])
    assert [seen.count(name) for name in ("segment", "smooth_depth")] == [1, 1]


def test_appearance_that_is_not_compared_is_not_computed() -> None:
    tracker = SERIAL.objects.tracker.model_copy(update={"compare_appearance": False})
    config = SERIAL.model_copy(update={"objects": SERIAL.objects.model_copy(update={"tracker": tracker})})
    slam, seen = V3DSLAM(CAMERA, segment_red, config), []
    slam.register_stage_hook(None, lambda name, *_: seen.append(name))
    slam(Walk()[0])
    assert "describe_appearance" not in seen and "classify_motion" in seen
