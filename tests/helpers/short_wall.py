"""Short sequence of a camera in front of a wall, instances for its frames, and runs along the wall."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.pipeline import Pipeline
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, Trajectory

CAMERA = PinholeCamera(fx=260.0, fy=260.0, cx=159.5, cy=119.5, width=320, height=240, readout=0.0)

WALL = 2.0
"""Distance from the camera to the wall, metres."""

STEP = 4
"""Motion of the image from frame to frame, pixels: the camera moves by 4 * 2 / 260 m."""

FRAMES = 14
"""Number of frames."""


class Wall:
    """Sequence of a camera that moves along a wall with a random texture; `square` gives its only instance.

    Args:
        broken: Index of a frame that cannot be read.
        interrupted: Index of a frame at which the run is interrupted.
    """

    name = "wall"
    camera = CAMERA

    def __init__(self, broken: int | None = None, interrupted: int | None = None) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (240 // 4, 480 // 4, 3), dtype=np.uint8)
        self._wall = cv2.resize(noise, (480, 240), interpolation=cv2.INTER_CUBIC)
        self._broken, self._interrupted = broken, interrupted
        self.stamps = torch.arange(FRAMES, dtype=torch.float64) / 10
        # Rotated by 1e-6 rad, because constant orientations count as placeholders.
        T_wc = se3_exp(torch.zeros(FRAMES, 6, dtype=torch.float64).index_fill_(1, torch.tensor(3), 1e-6))
        T_wc[0] = torch.eye(4)
        T_wc[:, 0, 3] = torch.arange(FRAMES) * STEP * WALL / CAMERA.fx
        self.groundtruth: Trajectory | None = Trajectory(self.stamps, T_wc)

    def __len__(self) -> int:
        return FRAMES

    def __getitem__(self, index: int) -> RGBDFrame:
        if index == self._broken:
            raise InputError("rgb/x.png: is truncated or no image; copy or download it again")
        if index == self._interrupted:
            raise KeyboardInterrupt
        image = torch.from_numpy(self._wall[:, STEP * index : STEP * index + 320].copy()).permute(2, 0, 1)
        return RGBDFrame(index, float(self.stamps[index]), image, torch.full((1, 240, 320), WALL))


class StoredWall(Wall):
    """The wall as an `RGBDSequence`, whose images can be read again."""

    def __iter__(self) -> Iterator[RGBDFrame]:
        return map(self.__getitem__, range(FRAMES))


def square(frame: RGBDFrame) -> Instances:
    """Segment a square in the middle of the image as a person."""
    mask = torch.zeros(1, 240, 320, dtype=torch.bool)
    mask[:, 90:150, 130:190] = True
    box = torch.tensor([[130.0, 90, 190, 150]])
    return Instances(mask, torch.zeros(1, dtype=torch.int64), torch.ones(1), box)


def make_pipeline(sequence: Wall | None = None, masks: Path | None = None, config: Config | None = None) -> Pipeline:
    """Make a pipeline with one object, the square, over a sequence along the wall; by default an intact one."""
    return Pipeline(sequence or Wall(), V3DSLAM(CAMERA, square, config), masks)


def run_along_wall(*overrides: str) -> Pipeline:
    """Run along the whole wall, with a keyframe every 5 frames."""
    pipeline = make_pipeline(config=load_config(overrides=["mapping.max_keyframe_interval=5", *overrides]))
    pipeline()
    return pipeline
