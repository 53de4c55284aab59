"""Back end: time of application, thread, errors, saved state."""

from __future__ import annotations

import copy
import gc
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import pytest
import torch
from helpers.first_frames import FirstFrames
from helpers.walk_with_loop import make_pipeline
from torch import Tensor

import v3d_torch.backend.back_end
from v3d_torch import V3DSLAM
from v3d_torch.backend.back_end import BackEnd
from v3d_torch.backend.loop_closer import LoopCorrection
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.mapping.culling import cull_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.local_bundle_adjustment import LocalAdjustment, local_bundle_adjust
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.pipeline import Pipeline

FRAMES = 6


def make_config(*, in_background: bool) -> Config:
    """Configuration with a keyframe at every second frame."""
    overrides = ("segmentation.source=none", "mapping.max_keyframe_interval=2", "mapping.redundant_ratio=1")
    return load_config(None, (*overrides, f"prefetch={str(in_background).lower()}"))


def keyframe_poses(slam: V3DSLAM) -> Tensor:
    return slam.map.T_cw


@pytest.mark.parametrize("in_background", [True, False])
def test_result_is_applied_with_the_next_frame(
    in_background: bool, demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames 0, 2 and 4 become keyframes; their results are applied to the map with frames 1, 3 and 5."""
    adjusted: list[tuple[int, str]] = []
    applied: list[int] = []

    def adjust(*args: object) -> LocalAdjustment | None:
        adjusted.append((args[1].frame, threading.current_thread().name))  # type: ignore[attr-defined]
        return local_bundle_adjust(*args)  # type: ignore[arg-type]

    original_apply = LocalAdjustment.apply

    def apply(self: LocalAdjustment, *args: object) -> None:
        applied.append(index)
        original_apply(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(v3d_torch.backend.back_end, "local_bundle_adjust", adjust)
    monkeypatch.setattr(LocalAdjustment, "apply", apply)
    slam = V3DSLAM(demo.camera, config=make_config(in_background=in_background))
    poses = []
    for index in range(FRAMES):
        slam(demo[index])
        poses.append(keyframe_poses(slam))
    assert [keyframe.frame for keyframe in slam.map.keyframes] == [0, 2, 4]
    assert [frame for frame, _ in adjusted] == [0, 2, 4]
    assert applied == [3, 5]  # for the first keyframe there is nothing to adjust
    assert torch.equal(poses[2][:1], poses[1]) and torch.equal(poses[4][:2], poses[3])
    assert not torch.equal(poses[3], poses[2]) and not torch.equal(poses[5], poses[4])
    main_thread = threading.current_thread().name
    assert {name == main_thread for _, name in adjusted} == {not in_background}


def test_flush_applies_the_pending_result_once(demo: RGBDSequence) -> None:
    """A second flush, or one before any frame, has no effect."""
    slam = V3DSLAM(demo.camera, config=make_config(in_background=True))
    slam.flush()
    for index in range(5):
        slam(demo[index])
    before = keyframe_poses(slam)
    assert slam.back_end.keyframe is slam.map.keyframes[-1]
    slam.flush()
    after = keyframe_poses(slam)
    assert slam.back_end.keyframe is None and not torch.equal(before, after)
    slam.flush()
    assert torch.equal(keyframe_poses(slam), after)
    assert torch.equal(slam.poses.T_cw, slam.map.keyframes[-1].T_cw)  # the last frame moves with its keyframe
    assert slam(demo[5]).T_wc.isfinite().all()


def test_loops_are_detected_from_the_adjusted_poses(demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch) -> None:
    slam = V3DSLAM(demo.camera, config=make_config(in_background=False))
    given: list[Tensor] = []

    def detect_loop(keyframe: Keyframe, sparse_map: SparseMap, T_cw: Tensor) -> None:
        given.append(T_cw)

    monkeypatch.setattr(slam.loop_closer, "detect_loop", detect_loop)
    for frame, is_adjusted in ((0, False), (2, True)):
        for index in range(len(slam.poses), frame + 1):
            slam(demo[index])
        assert len(slam.poses) == frame + 1
        result = slam.back_end.result()
        assert result is not None and (result.adjustment is not None) is is_adjusted
        assert torch.equal(given[-1], slam.map.T_cw if result.adjustment is None else result.adjustment.T_cw)
        assert torch.equal(given[-1], slam.map.T_cw) is not is_adjusted


def test_culled_keyframes_are_no_candidates_of_place_recognition(
    demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have no features left to verify a place, and would take the turn of a keyframe that has."""
    slam = V3DSLAM(demo.camera, config=make_config(in_background=False))
    for index in range(4):  # the result of frame 2 is applied with frame 3
        slam(demo[index])
    query = slam.map.keyframes[0].features.descriptors
    assert {index for index, _ in slam.loop_closer._database.query(query, 9)} == {0, 1}

    def cull(sparse_map: SparseMap, *_: object) -> None:
        cull_keyframes(sparse_map, {1: 0})

    monkeypatch.setattr(v3d_torch.backend.back_end, "cull_redundant_keyframes", cull)
    for index in range(4, 6):
        slam(demo[index])
    assert {index for index, _ in slam.loop_closer._database.query(query, 9)} == {0, 2}


def test_error_in_the_background_is_raised_with_the_next_frame(
    demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object) -> LocalAdjustment:
        raise ZeroDivisionError("no good")

    monkeypatch.setattr(v3d_torch.backend.back_end, "local_bundle_adjust", fail)
    slam = V3DSLAM(demo.camera, config=make_config(in_background=True))
    slam(demo[0])
    with pytest.raises(ZeroDivisionError, match="no good"):
        slam(demo[1])


@pytest.mark.parametrize("in_background", [True, False])
def test_run_that_an_error_in_the_background_ended_has_a_map(
    in_background: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = make_pipeline(prefetch=in_background)
    detect_loop = pipeline.slam.loop_closer.detect_loop

    def detect_or_fail(keyframe: Keyframe, *rest: Any) -> LoopCorrection | None:
        if keyframe.index == 3:
            raise MemoryError("too large")
        return detect_loop(keyframe, *rest)

    monkeypatch.setattr(pipeline.slam.loop_closer, "detect_loop", detect_or_fail)
    failure = pipeline().failure
    assert failure is not None and "too large" in str(failure)
    pipeline.flush()
    assert len(pipeline.fuse_points()) > 0
    assert pipeline.slam.back_end.keyframe is None


def test_thread_ends_when_the_system_is_deleted(demo: RGBDSequence) -> None:
    before = set(threading.enumerate())
    slam = V3DSLAM(demo.camera, config=make_config(in_background=True))
    slam(demo[0])
    slam.flush()
    (thread,) = set(threading.enumerate()) - before
    del slam
    gc.collect()
    thread.join(timeout=10)
    assert not thread.is_alive()


def test_pipeline_in_inference_mode_equals_calls_outside_of_it(demo: RGBDSequence) -> None:
    pipeline = Pipeline(FirstFrames(demo, FRAMES), V3DSLAM(demo.camera, config=make_config(in_background=True)))
    assert pipeline().failure is None
    pipeline.flush()
    slam = V3DSLAM(demo.camera, config=make_config(in_background=False))
    for index in range(FRAMES):
        slam(demo[index])
    slam.flush()
    assert torch.equal(slam.poses.trajectory().T_wc, pipeline.slam.poses.trajectory().T_wc)
    assert torch.equal(slam.map.landmarks["point"], pipeline.slam.map.landmarks["point"])


@pytest.mark.parametrize("inside", [range(FRAMES), range(FRAMES // 2), range(0, FRAMES, 2), range(-1, 0)])
def test_frames_inside_and_outside_of_inference_mode_equal_those_outside(inside: range, demo: RGBDSequence) -> None:
    """The range -1 makes only the system, and all others only frames, in inference mode."""
    config = make_config(in_background=False)
    expected = V3DSLAM(demo.camera, config=config)
    with torch.inference_mode(-1 in inside):
        slam = V3DSLAM(demo.camera, config=config)
    for index in range(FRAMES):
        expected(demo[index])
        with torch.inference_mode(index in inside):
            slam(demo[index])
    for each in (expected, slam):
        each.flush()
    assert torch.equal(slam.poses.trajectory().T_wc, expected.poses.trajectory().T_wc)
    assert torch.equal(slam.map.landmarks["point"], expected.map.landmarks["point"])
    assert expected.poses.T_cw.is_inference() is False


@pytest.mark.parametrize("copy_inside", [True, False])
def test_state_from_inference_mode_is_loaded_outside_of_it(copy_inside: bool, demo: RGBDSequence) -> None:
    config = make_config(in_background=False)
    slam, loaded = (V3DSLAM(demo.camera, config=config) for _ in range(2))
    for index in range(FRAMES // 2):
        with torch.inference_mode(not copy_inside):
            slam(demo[index])
    with torch.inference_mode(copy_inside):
        loaded.load_state_dict(copy.deepcopy(slam.state_dict()))
    for each in (slam, loaded):
        each(demo[FRAMES // 2])
        each.flush()
    assert torch.equal(slam.poses.trajectory().T_wc, loaded.poses.trajectory().T_wc)


@pytest.mark.parametrize("in_background", [True, False])
def test_back_end_that_loads_a_state_gives_the_pending_result(in_background: bool, demo: RGBDSequence) -> None:
    config = make_config(in_background=in_background)
    slam = V3DSLAM(demo.camera, config=config)
    for index in range(5):
        slam(demo[index])
    state, expected = slam.back_end.state_dict(), slam.back_end.result()
    assert state == {"keyframe": slam.map.keyframes[-1]} and state["keyframe"].frame == 4
    loaded = BackEnd(config, slam.map.camera, slam.map, slam.loop_closer)
    loaded.load_state_dict(state)
    assert loaded.keyframe is state["keyframe"]
    result = loaded.result()
    assert expected is not None and result is not None
    assert result.keyframe is expected.keyframe and result.loop_correction is expected.loop_correction is None
    assert expected.adjustment is not None and result.adjustment is not None
    assert torch.equal(result.adjustment.T_cw, expected.adjustment.T_cw)
    assert torch.equal(result.adjustment.points, expected.adjustment.points)


def test_places_after_the_pending_result_of_a_loaded_state_equal_those_without_interruption(demo: RGBDSequence) -> None:
    slam, loaded = (V3DSLAM(demo.camera, config=make_config(in_background=False)) for _ in range(2))
    for index in range(5):
        slam(demo[index])
    loaded.load_state_dict(copy.deepcopy(slam.state_dict()))
    places = []
    for each in (slam, loaded):
        each.flush()
        place = each.loop_closer.relocalise(each.map.keyframes[-1].features, each.map)
        assert place is not None
        places.append((place.keyframe.index, place.tracking.T_cw.tolist()))
    assert places[0] == places[1]


class ImmediateExecutor:
    """Executor that has computed a result before `submit` returns: the earliest that a thread can be."""

    def __init__(self, *_: object) -> None:
        pass

    def submit(self, function: Callable[[], object]) -> Future[object]:
        future: Future[object] = Future()
        future.set_result(function())
        return future


def test_loop_of_a_loaded_state_is_found_however_early_the_thread_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The database of places must be complete when the pending keyframe is submitted."""
    pipeline = make_pipeline(prefetch=False)
    slam = pipeline.slam
    for frame in pipeline.sequence:
        slam(frame)
        expected = slam.back_end.result()
        if expected is not None and expected.loop_correction is not None:
            break
    else:
        pytest.fail("no loop was found")
    state = slam.state_dict()
    monkeypatch.setattr(v3d_torch.backend.back_end, "ThreadPoolExecutor", ImmediateExecutor)
    loaded = make_pipeline(prefetch=True).slam
    for _ in range(2):  # into a new system, and over a pending computation
        loaded.load_state_dict(state)
        result = loaded.back_end.result()
        assert result is not None and result.loop_correction is not None
        assert result.loop_correction.place.keyframe is expected.loop_correction.place.keyframe
        assert torch.equal(result.loop_correction.T_cw, expected.loop_correction.T_cw)


def test_discarded_computation_has_ended(demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[bool] = []

    def adjust(*_: object) -> None:
        time.sleep(0.2)
        ended.append(True)

    monkeypatch.setattr(v3d_torch.backend.back_end, "local_bundle_adjust", adjust)
    slam = V3DSLAM(demo.camera, config=make_config(in_background=True))
    slam(demo[0])
    slam.back_end.discard()
    assert ended and slam.back_end.keyframe is None and slam.back_end.result() is None


def test_state_without_a_pending_keyframe_submits_nothing(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, config=make_config(in_background=True))
    slam(demo[0])
    pending = slam.back_end.state_dict()
    slam.flush()
    state = slam.back_end.state_dict()
    assert state == {"keyframe": None}
    slam.back_end.load_state_dict(pending)
    slam.back_end.load_state_dict(state)
    assert slam.back_end.keyframe is None and slam.back_end.result() is None
