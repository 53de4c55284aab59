"""The pixels around an object's points in the image, and those whose depth its points explain.

A network draws outlines at a quarter of the image's resolution: it rounds off hands and takes slices of the wall along.
The object's cloud, cleaned of what does not belong to it, says which depths are its own, place by place.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.camera import PinholeCamera

_CELL = 4
"""Side of the cells in which the depths of a cloud are gathered, pixels: those of the network's masks."""

_NONE = 1e6
"""Depth of cells without points, metres: farther than anything."""

_NEAREST = 0.1
"""Points nearer than this, or behind the camera, have no place in the image, metres."""


def silhouettes(clouds: Sequence[Tensor], camera: PinholeCamera, spacing: float) -> list[Silhouette]:
    """Clouds as they lie in an image, all at once.

    Args:
        clouds: camera frame, metres, each of shape :math:`(P, 3)`.
        camera: that takes the image.
        spacing: of the points, metres: gaps of this size are closed.
    """
    if not clouds:
        return []
    points = torch.cat([cloud.to(torch.float64) for cloud in clouds])
    pixels, inside = camera.locate(points, _NEAREST)
    # Pixel centres lie at integers: a cell begins half a pixel before its first.
    cells = np.floor((pixels.numpy() + 0.5) / _CELL).astype(np.int64)
    z, seen = points[:, 2].numpy().astype(np.float32), inside.numpy()
    ends = np.cumsum([len(cloud) for cloud in clouds]).tolist()
    drawn = []
    for begin, end in pairwise([0, *ends]):
        own = seen[begin:end]
        drawn.append(Silhouette(cells[begin:end][own], z[begin:end][own], camera, spacing))
    return drawn


class Silhouette:
    """A cloud as it lies in an image.

    Args:
        cells: (column, row) of the cell of each point, int64, shape :math:`(P, 2)`.
        z: depth of each, metres, float32, shape :math:`(P,)`.
        camera: that takes the image.
        spacing: of the points, metres.
    """

    def __init__(self, cells: NDArray[np.int64], z: NDArray[np.float32], camera: PinholeCamera, spacing: float) -> None:
        self._cells, self._z = cells, z
        self._gap = 0.0
        if len(z):
            middle = len(z) // 2
            self._gap = spacing * camera.fx / float(np.partition(z, middle)[middle])
            self._first, self._last = cells.min(axis=0).tolist(), cells.max(axis=0).tolist()

    def __call__(
        self, depth: Tensor, margin: int, tolerance: float, *, step: int = 1, or_missing: bool = False
    ) -> Tensor:
        """Pixels near the points whose depth the points around explain.

        Args:
            depth: metres, of every n-th pixel, shape :math:`(1, h, w)`; 0 = no measurement.
            margin: pixels by which the outline is farther out than the outermost points.
            tolerance: metres by which depth may lie before or behind the points around it.
            step: that n.
            or_missing: takes pixels without depth that are near as well.

        Returns:
            bool, shape :math:`(h, w)`; none where no point is in the image.
        """
        explained = torch.zeros(depth.shape[1:], dtype=torch.bool)
        if len(self._z) == 0:
            return explained
        radius = max(round((margin + self._gap) / _CELL), 1)
        # Nothing is near beyond the radius: all that follows looks at this part of the image only.
        left, top = (max(first - radius, 0) for first in self._first)
        right, bottom = (last + radius + 1 for last in self._last)
        rows, columns = bottom - top, right - left
        cell = (self._cells[:, 1] - top) * columns + self._cells[:, 0] - left
        front, back = np.full(rows * columns, _NONE, np.float32), np.full(rows * columns, -_NONE, np.float32)
        np.minimum.at(front, cell, self._z)
        np.maximum.at(back, cell, self._z)
        around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        nearest = cv2.erode(front.reshape(rows, columns), around, borderValue=_NONE)
        farthest = cv2.dilate(back.reshape(rows, columns), around, borderValue=-_NONE)
        v, of_row = _pixels(top, bottom, step, depth.shape[1])
        u, of_column = _pixels(left, right, step, depth.shape[2])
        # Columns first, while there are few rows.
        low, high = (cells.take(of_column, axis=1).take(of_row, axis=0) for cells in (nearest, farthest))
        z = depth[0].numpy()[v, u]  # NumPy compares in a third of torch's time
        fits = (z > low - tolerance) & (z < high + tolerance)
        if or_missing:
            fits |= (z <= 0) & (low < _NONE)
        explained.numpy()[v, u] = fits
        return explained

    def share_seen(self, depth: Tensor, tolerance: float) -> float:
        """Share of the points where the depth is theirs; 0 where no point is in the image.

        Args:
            depth: metres, shape :math:`(1, H, W)`; 0 = no measurement.
            tolerance: metres by which it may lie before or behind a point.
        """
        if len(self._z) == 0:
            return 0.0
        _, height, width = depth.shape
        u, v = np.minimum(_CELL * self._cells + _CELL // 2, (width - 1, height - 1)).T
        return float((np.abs(depth[0].numpy()[v, u] - self._z) < tolerance).mean())


def _pixels(first: int, last: int, step: int, size: int) -> tuple[slice, NDArray[np.int64]]:
    """Along one axis, which of every n-th pixel lie in the cells from ``first`` to before ``last``, and their cells."""
    begin, end = -(-first * _CELL // step), min(-(-last * _CELL // step), size)
    return slice(begin, end), np.arange(begin, end) * step // _CELL - first
