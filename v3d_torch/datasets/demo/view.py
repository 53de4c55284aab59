"""Camera rays of an oversampled image, and their relation to world points and vectors at a camera pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera

OVERSAMPLING = 2
"""Samples per pixel along each axis."""

_MIN_DEPTH = 0.05
"""Points nearer than this, or behind the camera, are not projected, metres: the projection degenerates there."""

Window = tuple[slice, slice, slice]
"""Part of an oversampled image: samples, rows, columns."""


@dataclass(frozen=True)
class RayGrid:
    """Rays :math:`(x, y, 1)` of an oversampled image, stored separably: x per column and y per row.

    Attributes:
        x: Normalised image x, shape :math:`(S, 1, W)`, with S samples per pixel placed symmetrically about its centre.
        y: Normalised image y, shape :math:`(S, H, 1)`.
    """

    x: Tensor
    y: Tensor

    @staticmethod
    def from_camera(camera: PinholeCamera) -> RayGrid:
        """Return the rays of a camera without distortion."""
        offset = (torch.arange(OVERSAMPLING, dtype=torch.float32) + 0.5) / OVERSAMPLING - 0.5
        down, right = (o.reshape(-1, 1) for o in torch.meshgrid(offset, offset, indexing="ij"))
        x = (torch.arange(camera.width, dtype=torch.float32) + right - camera.cx) / camera.fx
        y = (torch.arange(camera.height, dtype=torch.float32) + down - camera.cy) / camera.fy
        return RayGrid(x[:, None, :], y[:, :, None])


@dataclass(frozen=True)
class View:
    """Camera rays at a camera pose.

    Attributes:
        rays: Rays of the camera.
        T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
    """

    rays: RayGrid
    T_wc: NDArray[np.float64]

    def rotate_to_camera(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rotate world vectors to the camera frame, shape :math:`(..., 3)`."""
        return vector @ self.T_wc[:3, :3]

    def transform_to_camera(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform world points to the camera frame, shape :math:`(..., 3)`."""
        return (point - self.T_wc[:3, 3]) @ self.T_wc[:3, :3]

    def dot_rays(self, vector: NDArray[np.float64], window: Window) -> Tensor:
        """Return the dot product of all rays in a window with a camera-frame vector, shape :math:`(S, h, w)`."""
        x, y, z = map(float, vector)
        _, rows, columns = window
        return x * self.rays.x[:, :, columns] + (y * self.rays.y[:, rows] + z)

    def visible_window(self, points: NDArray[np.float64]) -> Window | None:
        """Return a window that contains the projection of the convex hull of world points.

        Args:
            points: World points, metres, shape :math:`(N, 3)`.

        Returns:
            The window; the whole image if the hull reaches behind the camera; None if it is out of view.
        """
        points = self.transform_to_camera(points)
        behind = points[:, 2] < _MIN_DEPTH
        if behind.all():
            return None
        if behind.any():
            return slice(None), slice(None), slice(None)
        xy = points[:, :2] / points[:, 2:]
        rows = _covered_slice(self.rays.y[0, :, 0], xy[:, 1])
        columns = _covered_slice(self.rays.x[0, 0], xy[:, 0])
        return None if rows is None or columns is None else (slice(None), rows, columns)


def _covered_slice(axis: Tensor, values: NDArray[np.float64]) -> slice | None:
    """Pixels between the smallest and largest value, with a margin of one because the samples of a pixel differ."""
    first, last = np.searchsorted(axis.numpy(), (values.min(), values.max()))
    if last == 0 or first == len(axis):
        return None
    return slice(max(int(first) - 1, 0), int(last) + 1)
