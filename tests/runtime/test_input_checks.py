"""Frames and instances that callers make themselves: what is wrong with them is said at the door."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame

CAMERA = PinholeCamera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
FRAME = RGBDFrame(7, 2.0, torch.zeros(3, 48, 64, dtype=torch.uint8), torch.ones(1, 48, 64), camera=CAMERA)
INSTANCES = Instances(torch.ones(2, 48, 64).bool(), torch.tensor([0, 56]), torch.ones(2), torch.zeros(2, 4))


def slam(segment: Callable[[RGBDFrame], Any] | None = None) -> V3DSLAM:
    return V3DSLAM(None, segment, load_config(overrides=["segmentation.source=none"]))


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (torch.zeros(3, 48, 64), "takes frames, this is a Tensor"),
        (replace(FRAME, image=FRAME.image.permute(1, 2, 0)), r"colour image is torch.uint8 of shape \(48, 64, 3\)"),
        (replace(FRAME, image=FRAME.image.float()), "colour image is torch.float32"),
        (replace(FRAME, image=FRAME.image.numpy()), "colour image is a ndarray"),
        (replace(FRAME, depth=FRAME.depth[0]), r"depth image is torch.float32 of shape \(48, 64\)"),
        (replace(FRAME, depth=FRAME.depth.double()), "depth image is torch.float64"),
        (replace(FRAME, depth=None), "depth image is a NoneType"),
        (replace(FRAME, stamp=float("nan")), "the stamp is nan"),
        (replace(FRAME, delay=float("inf")), "the delay of depth is inf"),
        (replace(FRAME, camera=replace(CAMERA, width=80)), r"colour image .* of shape \(3, 48, 80\)"),
    ],
)
def test_what_is_no_frame(frame: RGBDFrame, message: str) -> None:
    with pytest.raises(InputError, match=message):
        slam()(frame)


def test_what_is_right_is_taken_and_tells_the_camera() -> None:
    system = slam(lambda _: INSTANCES)
    assert system.camera is None
    assert system(FRAME).stamp == 2.0 and system.camera == CAMERA
    assert system(replace(FRAME, stamp=2.1, camera=None)).stamp == 2.1


def test_a_frame_of_another_camera() -> None:
    system = slam()
    system(FRAME)
    with pytest.raises(InputError, match="frame 7: carries another camera"):
        system(replace(FRAME, stamp=3.0, camera=replace(CAMERA, fx=61.0)))
    with pytest.raises(ConfigError, match="the camera is not known"):
        slam()(replace(FRAME, camera=None))


@pytest.mark.parametrize("stamp", [2.0, 1.9])
def test_a_frame_that_is_not_after_the_last_costs_nothing(stamp: float) -> None:
    system = slam()
    system(FRAME)
    with pytest.raises(InputError, match=rf"its stamp, {stamp:.6f} s, is not after 2\.000000 s"):
        system(replace(FRAME, stamp=stamp))
    assert len(system.poses.statuses) == 1
    system(replace(FRAME, stamp=2.2))
    assert system.poses.trajectory().stamps.tolist() == [2.0, 2.2]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (None, "gave a NoneType for frame 7"),
        (replace(INSTANCES, masks=INSTANCES.masks.numpy()), "masks for frame 7 are a ndarray"),
        (replace(INSTANCES, masks=INSTANCES.masks.float()), "masks for frame 7 are torch.float32"),
        (replace(INSTANCES, masks=INSTANCES.masks[:, ::2, ::2]), r"masks for frame 7 are torch.bool of shape \(2, 24"),
        (replace(INSTANCES, labels=torch.tensor([0])), r"labels for frame 7 are torch.int64 of shape \(1,\)"),
        (replace(INSTANCES, scores=INSTANCES.scores.double()), "scores for frame 7 are torch.float64"),
        (replace(INSTANCES, boxes=torch.zeros(2, 5)), r"boxes for frame 7 are torch.float32 of shape \(2, 5\)"),
    ],
)
def test_what_a_segmenter_must_not_give(given: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        slam(lambda _: given)(FRAME)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"config": "paper"}, r'config .* is a str; .* load_config\("paper"\)'),
        ({"config": {"seed": 1}}, "config .* is a dict"),
        ({"camera": "tum_fr1"}, "camera .* is a str"),
        ({"camera": np.eye(3)}, "camera .* is a ndarray"),
    ],
)
def test_what_no_system_is_made_of(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        V3DSLAM(segment=NoSegmentation(), **parts)
