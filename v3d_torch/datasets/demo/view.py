"""A camera pose with its bundle of rays: linear forms over the image, and windows that bodies can touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera

OVERSAMPLING = 2
"""Samples per pixel and axis."""

Window = tuple[slice, slice, slice]
"""Samples, rows, columns."""


@dataclass(frozen=True)
class Rays:
    """Every ray :math:`(x, y, 1)` of an oversampled image, without the grid: x by column, y by row.

    Attributes:
        x: shape :math:`(S, 1, W)`, S samples per pixel, symmetric about its centre.
        y: shape :math:`(S, H, 1)`.
    """

    x: Tensor
    y: Tensor

    @staticmethod
    def of(camera: PinholeCamera) -> Rays:
        """The rays of a camera without distortion."""
        offset = (torch.arange(OVERSAMPLING, dtype=torch.float32) + 0.5) / OVERSAMPLING - 0.5
        down, right = (o.reshape(-1, 1) for o in torch.meshgrid(offset, offset, indexing="ij"))
        x = (torch.arange(camera.width, dtype=torch.float32) + right - camera.cx) / camera.fx
        y = (torch.arange(camera.height, dtype=torch.float32) + down - camera.cy) / camera.fy
        return Rays(x[:, None, :], y[:, :, None])


@dataclass(frozen=True)
class View:
    """Rays seen from a pose.

    Attributes:
        rays: of the camera.
        T_wc: camera-to-world, shape :math:`(4, 4)`.
    """

    rays: Rays
    T_wc: NDArray[np.float64]

    def direction(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rotate a world vector into the camera's frame."""
        return vector @ self.T_wc[:3, :3]

    def point(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """World points to the camera's frame, shape :math:`(..., 3)`."""
        return (point - self.T_wc[:3, 3]) @ self.T_wc[:3, :3]

    def along(self, vector: NDArray[np.float64], window: Window) -> Tensor:
        """Dot product of every ray in a window with a vector of the camera's frame, shape :math:`(S, h, w)`."""
        x, y, z = map(float, vector)
        _, rows, columns = window
        return x * self.rays.x[:, :, columns] + (y * self.rays.y[:, rows] + z)

    def window(self, points: NDArray[np.float64]) -> Window | None:
        """Part of the image that the convex hull of world points can touch; None when it is out of view."""
        points = self.point(points)
        behind = points[:, 2] < 0.05
        if behind.all():
            return None
        if behind.any():
            return slice(None), slice(None), slice(None)
        xy = points[:, :2] / points[:, 2:]
        rows = _touched(self.rays.y[0, :, 0], xy[:, 1])
        columns = _touched(self.rays.x[0, 0], xy[:, 0])
        return None if rows is None or columns is None else (slice(None), rows, columns)


def _touched(axis: Tensor, values: NDArray[np.float64]) -> slice | None:
    """The pixels between the least and the greatest value, and one more each side for the other samples."""
    first, last = np.searchsorted(axis.numpy(), (values.min(), values.max()))
    if last == 0 or first == len(axis):
        return None
    return slice(max(int(first) - 1, 0), int(last) + 1)
