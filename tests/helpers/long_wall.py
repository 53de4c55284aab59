"""Sequence of a camera that moves along a long wall with a random texture: every place of the wall is unique."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import RGBDFrame, Trajectory

CAMERA = PinholeCamera(fx=260.0, fy=260.0, cx=159.5, cy=119.5, width=320, height=240, readout=0.0)
DISTANCE = 2.0
"""Distance from the camera to the wall, metres."""
LENGTH = 1600
"""Length of the wall, pixels of an image."""


class Slide:
    """Frames from one place on the wall to another, at 10 Hz.

    Args:
        first: Column of the wall at the left border of the first image.
        last: Column of the wall at the left border of the last image.
        step: Columns from frame to frame.
        dark: Indices of frames with a black image; their depth is valid.
        seed: Seed of the wall's texture.
    """

    name = "slide"
    camera = CAMERA

    def __init__(self, first: int, last: int, step: int = 8, dark: tuple[int, ...] = (), seed: int = 0) -> None:
        noise = np.random.default_rng(seed).integers(0, 256, (240 // 4, LENGTH // 4, 3), dtype=np.uint8)
        self._wall = cv2.resize(noise, (LENGTH, 240), interpolation=cv2.INTER_CUBIC)
        self._columns = range(first, last + 1, step) if first <= last else range(first, last - 1, -step)
        self._dark = dark
        self.stamps = torch.arange(len(self), dtype=torch.float64) / 10
        self.groundtruth: Trajectory | None = Trajectory(self.stamps, self.T_wc)

    @property
    def T_wc(self) -> Tensor:
        """Poses in the world frame of a camera at the start of the wall.

        All are rotated by 1e-6 rad, because constant identity orientations count as placeholders.
        """
        T_wc = se3_exp(torch.zeros(len(self), 6, dtype=torch.float64).index_fill_(1, torch.tensor(3), 1e-6))
        T_wc[:, 0, 3] = torch.tensor([column * DISTANCE / CAMERA.fx for column in self._columns])
        return T_wc

    def __len__(self) -> int:
        return len(self._columns)

    def __getitem__(self, index: int) -> RGBDFrame:
        column = self._columns[index]
        image = torch.from_numpy(self._wall[:, column : column + 320].copy()).permute(2, 0, 1)
        if index in self._dark:
            image = torch.zeros_like(image)
        return RGBDFrame(index, float(self.stamps[index]), image, torch.full((1, 240, 320), DISTANCE))


class Jump:
    """Frames at one end of a long wall, then at its other end."""

    name, camera, groundtruth = "jump", CAMERA, None

    def __iter__(self) -> Iterator[RGBDFrame]:
        frames = [
            frame for part in (Slide(0, 200), Slide(960, 1120)) for frame in map(part.__getitem__, range(len(part)))
        ]
        return (replace(frame, index=index, stamp=index / 10) for index, frame in enumerate(frames))
