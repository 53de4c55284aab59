"""Walk along a wall with a person, an unlabelled box, darkness and a loop: a run that exercises all state."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.frame_result import FrameResult
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.pipeline import FrameCallback, Pipeline
from v3d_torch.segmentation import UprightSegmenter
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, Trajectory

CAMERA = PinholeCamera(fx=130.0, fy=130.0, cx=79.5, cy=59.5, width=160, height=120)
FORWARD, DARK, BACKWARD = range(0, 180, 9), [180] * 12, range(360, 60, -10)
"""Columns of the wall at the left border of the images: forward, in the dark, and backward from farther on."""
CONFIG = load_config(
    overrides=[
        *("features.count=400", "features.levels=4", "mapping.max_keyframe_interval=3", "mapping.min_tracked=30"),
        *("mapping.landmarks_per_keyframe=200", "loop.min_keyframe_gap=2"),
        *("loop.min_inliers=20", "loop.min_inlier_ratio=0.1"),
        *("objects.clouds.stride=1", "objects.clouds.min_points=10", "objects.free_space.min_points=10"),
    ]
)


class Walk:
    """Sequence along a textured wall, with a walking red person, sometimes not detected, and an unlabelled box.

    Args:
        frames: Number of frames; by default all, of which the last ones close the loop.
    """

    name = "walk"
    camera = CAMERA
    groundtruth: Trajectory | None = None

    def __init__(self, frames: int | None = None) -> None:
        noise = np.random.default_rng(0).integers(0, 200, (30, 140, 3), dtype=np.uint8)
        self._wall = cv2.resize(noise, (560, 120), interpolation=cv2.INTER_CUBIC)
        self._columns = [*FORWARD, *DARK, *BACKWARD][:frames]
        self.stamps = torch.arange(len(self), dtype=torch.float64) / 10

    def __len__(self) -> int:
        return len(self._columns)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> RGBDFrame:
        if not 0 <= index < len(self):
            raise IndexError(index)
        column = self._columns[index]
        image = self._wall[:, column : column + 160].copy()
        depth = np.full((120, 160), 2.0, np.float32)
        walker, box = 10 + 6 * (index % 20), 120 - 5 * (index % 16)
        image[30:110, walker : walker + 24] = 255, 0, 0
        image[70:110, walker : walker + 24] = 254, 0, 0  # the legs
        depth[30:110, walker : walker + 24] = 1.5
        image[5:28, box : box + 26] //= 2
        depth[5:28, box : box + 26] = 1.2
        if index in range(len(FORWARD), len(FORWARD) + len(DARK)):
            image[:], depth[:] = 0, 0
        return RGBDFrame(
            index, float(self.stamps[index]), torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(depth)[None]
        )

    def motion_mask(self, index: int) -> Tensor:
        return (self[index].image[0] >= 254).to(torch.uint8)


def segment_red(frame: RGBDFrame) -> Instances:
    """Segment the red person, with a higher score if upright; misses it in every fourth frame."""
    red, height, width = frame.image[0], *frame.image.shape[1:]
    mask = red >= 254
    if frame.index % 4 == 3 or not mask.any():
        return Instances.empty(height, width)
    rows = torch.arange(height)[:, None].expand(height, width)
    upright = rows[red == 255].float().mean() < rows[red == 254].float().mean()
    score = torch.tensor([0.9 if upright else 0.4])
    return Instances(mask[None], torch.tensor([0]), score, torch.zeros(1, 4))


def make_pipeline(*, prefetch: bool) -> Pipeline:
    config = CONFIG.model_copy(update={"prefetch": prefetch})
    return Pipeline(Walk(), V3DSLAM(CAMERA, UprightSegmenter(segment_red), config))


def interrupt_after(stop: int) -> FrameCallback:
    """Return a callback that interrupts the run after a frame."""

    def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
        if frame.index == stop:
            raise KeyboardInterrupt

    return on_frame
