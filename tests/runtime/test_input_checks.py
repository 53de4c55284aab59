"""Checks of frames, instances and parameters given by callers."""

from __future__ import annotations

import copy
import pickle
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame

CAMERA = PinholeCamera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
FRAME = RGBDFrame(7, 2.0, torch.zeros(3, 48, 64, dtype=torch.uint8), torch.ones(1, 48, 64), camera=CAMERA)
INSTANCES = Instances(torch.ones(2, 48, 64).bool(), torch.tensor([0, 56]), torch.ones(2), torch.zeros(2, 4))


def make_slam(segment: Callable[[RGBDFrame], Any] | None = None) -> V3DSLAM:
    return V3DSLAM(CAMERA, segment, load_config(overrides=["segmentation.source=none"]))


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (torch.zeros(3, 48, 64), r"expected an RGBDFrame, got a Tensor; RGBDFrame\.from_arrays"),
        (replace(FRAME, image=FRAME.image.permute(1, 2, 0)), r"colour image is torch.uint8 of shape \(48, 64, 3\)"),
        (replace(FRAME, image=FRAME.image.float()), "colour image is torch.float32"),
        (replace(FRAME, image=FRAME.image.numpy()), "colour image is a ndarray"),
        (replace(FRAME, depth=FRAME.depth[0]), r"depth image is torch.float32 of shape \(48, 64\)"),
        (replace(FRAME, depth=FRAME.depth.double()), "depth image is torch.float64"),
        (replace(FRAME, depth=None), "depth image is a NoneType"),
        (replace(FRAME, stamp=float("nan")), "frame 7: the stamp is nan; give a finite number of seconds"),
        (replace(FRAME, depth_delay=float("inf")), "frame 7: the depth delay is inf; give a finite number of seconds"),
        (
            replace(FRAME, image=torch.zeros(3, 48, 80, dtype=torch.uint8), camera=replace(CAMERA, width=80)),
            r"colour image is torch.uint8 of shape \(3, 48, 80\), expected .* of shape \(3, 48, 64\)",
        ),
        (replace(FRAME, camera=replace(CAMERA, width=80)), "frame 7: its camera differs from that of the V3DSLAM"),
    ],
)
def test_invalid_frame_is_rejected(frame: RGBDFrame, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_slam()(frame)


@pytest.mark.parametrize(
    ("gravity", "found"),
    [
        (torch.tensor([0, 1.01, 0], dtype=torch.float64), r"\[0\.0, 1\.01, 0\.0\]"),
        (torch.tensor([0, torch.nan, 1], dtype=torch.float64), r"\[0\.0, nan, 1\.0\]"),
        (torch.ones(1, dtype=torch.float64), r"torch\.float64 of shape \(1,\), expected .* of shape \(3,\)"),
        (torch.tensor([0.0, 1.0, 0.0]), r"torch\.float32 of shape \(3,\), expected a tensor, torch\.float64"),
        (np.array([0.0, 1.0, 0.0]), "a ndarray"),
    ],
)
def test_gravity_that_is_no_unit_vector_is_rejected(gravity: Any, found: str) -> None:
    with pytest.raises(InputError, match=f"frame 7: the gravity is {found}.*; give a unit vector in the camera frame"):
        make_slam()(replace(FRAME, gravity=gravity))
    make_slam()(replace(FRAME, gravity=torch.tensor([0, 1.0005, 0], dtype=torch.float64)))


def test_segmenter_that_assigns_ids_is_rejected() -> None:
    slam = make_slam(lambda _: replace(INSTANCES, track_ids=torch.tensor([1, 2])))
    with pytest.raises(ConfigError, match="the segmenter's track_ids for frame 7 are set; leave them None"):
        slam(FRAME)


def test_valid_frames_are_tracked_with_and_without_a_camera() -> None:
    slam = make_slam(lambda _: INSTANCES)
    assert slam.camera == CAMERA
    assert slam(FRAME).stamp == 2.0
    assert slam(replace(FRAME, stamp=2.1, camera=None)).stamp == 2.1
    assert make_slam()(replace(FRAME, camera=None)).stamp == 2.0


def test_frame_of_another_camera_is_rejected() -> None:
    slam, other = make_slam(), replace(CAMERA, fx=61.0)
    message = "frame 7: its camera differs from that of the V3DSLAM; make one V3DSLAM for each camera"
    with pytest.raises(InputError, match=message):
        slam(replace(FRAME, camera=other))
    slam(FRAME)
    with pytest.raises(InputError, match=message):
        slam(replace(FRAME, stamp=3.0, camera=other))
    assert len(slam.poses.statuses) == 1


@pytest.mark.parametrize(("depth", "message"), [(1220.0, "1.2e+03 m; give depth in metres"), (0.001, "0.001 m")])
def test_first_depth_that_is_not_in_metres_is_rejected(depth: float, message: str) -> None:
    """Floating-point depth in millimetres tracked nothing, without a word."""
    slam = make_slam()
    with pytest.raises(InputError, match=re.escape(f"frame 7: its median depth is {message}")):
        slam(replace(FRAME, depth=torch.full((1, 48, 64), depth)))
    slam(replace(FRAME, depth=torch.zeros(1, 48, 64)))  # a covered lens
    slam(replace(FRAME, stamp=2.1, depth=torch.full((1, 48, 64), 0.02)))  # a later frame can be close to a wall


@pytest.mark.parametrize("stamp", [2.0, 1.9, 2.0000004])
def test_frame_that_is_not_later_is_rejected_without_effect(stamp: float) -> None:
    slam = make_slam()
    slam(FRAME)
    with pytest.raises(InputError, match=rf"its stamp, {stamp:.6f} s, is not after 2\.000000 s"):
        slam(replace(FRAME, stamp=stamp))
    assert len(slam.poses.statuses) == 1
    slam(replace(FRAME, stamp=2.2))
    assert slam.poses.trajectory().stamps.tolist() == [2.0, 2.2]


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, "the segmenter returned a NoneType for frame 7; it must return Instances"),
        (replace(INSTANCES, masks=INSTANCES.masks.numpy()), "masks for frame 7 are a ndarray"),
        (replace(INSTANCES, masks=INSTANCES.masks.float()), "masks for frame 7 are torch.float32"),
        (replace(INSTANCES, masks=INSTANCES.masks[:, ::2, ::2]), r"masks for frame 7 are torch.bool of shape \(2, 24"),
        (replace(INSTANCES, labels=torch.tensor([0])), r"labels for frame 7 are torch.int64 of shape \(1,\)"),
        (replace(INSTANCES, labels=torch.tensor([0, 80])), "labels for frame 7 contain 80, .* the label -1$"),
        (replace(INSTANCES, labels=torch.tensor([-2, -1])), "labels for frame 7 contain -2, expected COCO classes"),
        (replace(INSTANCES, scores=INSTANCES.scores.double()), "scores for frame 7 are torch.float64"),
        (replace(INSTANCES, boxes=torch.zeros(2, 5)), r"boxes for frame 7 are torch.float32 of shape \(2, 5\)"),
        (
            replace(INSTANCES, scores=torch.tensor([0.5, torch.nan])),
            "scores for frame 7 have values that are not from",
        ),
        (
            replace(INSTANCES, scores=torch.tensor([0.5, 1.1])),
            "frame 7 have values that are not from 0 to 1$",
        ),
        (replace(INSTANCES, boxes=torch.full((2, 4), torch.inf)), "boxes for frame 7 have values that are not finite$"),
    ],
)
def test_invalid_output_of_the_segmenter_is_rejected(returned: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_slam(lambda _: returned)(FRAME)


def test_instances_without_pixels_are_left_out() -> None:
    none = replace(INSTANCES, masks=torch.zeros_like(INSTANCES.masks))
    some = replace(INSTANCES, masks=torch.stack([none.masks[0], INSTANCES.masks[1]]))
    segmentation = make_slam(lambda _: some).segment_instances(FRAME, None)
    assert segmentation.instances is not None and segmentation.instances.labels.tolist() == [56]
    assert make_slam(lambda _: none)(FRAME).objects == []
    assert make_slam(lambda _: INSTANCES).segment_instances(FRAME, None).instances is INSTANCES


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"config": "paper"}, r'needs a Config, got a str; .* load_config\("paper"\)'),
        ({"config": {"seed": 1}}, "needs a Config, got a dict"),
        ({"camera": None}, r"needs a PinholeCamera, got a NoneType; .* sequence\.camera"),
        ({"camera": "tum_fr1"}, r"needs a PinholeCamera, got a str; .* sequence\.camera"),
        ({"camera": np.eye(3)}, r"needs a PinholeCamera, got a ndarray; .* sequence\.camera"),
    ],
)
def test_parameter_of_wrong_type_is_rejected(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        V3DSLAM(**{"camera": CAMERA, "segment": NoSegmentation(), **parameters})


@pytest.mark.parametrize("indices", [range(0, 12), range(1, 25, 2), [3, 3, 3], [0, 1, 4, 5, 6, 11]])
def test_one_of_two_frames_is_segmented_whatever_their_indices(indices: Sequence[int]) -> None:
    """A source can leave out frames, and begin with any index."""
    slam = V3DSLAM(CAMERA, lambda _: INSTANCES, load_config(overrides=["segmentation.interval=2"]))
    due = [slam.segment_instances(replace(FRAME, index=index), None).instances is not None for index in indices]
    last, expected = None, []
    for index in indices:
        expected.append(last is None or index - last >= 2 or index == last)
        last = index if expected[-1] else last
    assert due == expected and due[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stamp": 1.7e12}, "the stamp is 1700000000000.0, in another unit or wrong; give seconds"),
        ({"stamp": "now"}, "the stamp is 'now'; give a finite number of seconds"),
        ({"stamp": torch.tensor(1.0)}, "the stamp is tensor"),
        ({"depth_delay": None}, "the depth delay is None; give a finite number"),
        ({"index": "a"}, "frame 'a': its index is no whole number"),
    ],
)
def test_wrong_times_and_indices_are_rejected_before_the_frame_is_processed(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        make_slam()(replace(FRAME, **changes))


def test_masked_depth_is_no_measurement() -> None:
    depth = np.ma.masked_greater(np.array([[1.0, 9.0]]), 5)
    frame = RGBDFrame.from_arrays(0, 0.0, np.zeros((1, 2, 3), np.uint8), depth)
    assert frame.depth.tolist() == [[[1.0, 0.0]]]


def test_stored_map_in_place_of_its_map_is_named() -> None:
    known: Any = object()
    with pytest.raises(ConfigError, match=r"V3DSLAM needs a SparseMap, got a object; give load_map\(...\)\.map"):
        V3DSLAM(CAMERA, lambda _: INSTANCES, known_map=known)


def test_known_map_of_another_camera_is_rejected() -> None:
    known = SparseMap.empty(Config(), replace(CAMERA, fx=CAMERA.fx + 1))
    with pytest.raises(ConfigError, match="the known map was loaded for another camera; load it with the camera of"):
        V3DSLAM(CAMERA, lambda _: INSTANCES, known_map=known)


@pytest.mark.parametrize("function", [copy.copy, copy.deepcopy, pickle.dumps])
def test_system_can_be_neither_copied_nor_pickled(function: Callable[[V3DSLAM], object]) -> None:
    with pytest.raises(TypeError, match="cannot be pickled or copied; use save_state, and load_state with a new"):
        function(make_slam())
