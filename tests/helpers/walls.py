"""A camera that slides along a long wall covered with noise: every place of it looks different."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import RGBDFrame, Trajectory

CAMERA = PinholeCamera(fx=260.0, fy=260.0, cx=159.5, cy=119.5, width=320, height=240, readout=0.0)
DISTANCE = 2.0
"""From the camera to the wall, metres."""
LENGTH = 1600
"""Of the wall, pixels of an image."""


class Slide:
    """Frames from one place on the wall to another, 10 a second.

    Args:
        first: column of the wall at the first image's left border.
        last: at the last image's.
        step: columns from frame to frame.
        dark: frames that show nothing, with depth.
        seed: of the wall.
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
        """In the world of the camera at the wall's beginning; turned by next to nothing, as placeholders are not."""
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
