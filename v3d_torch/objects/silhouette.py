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

from v3d_torch.geometry.camera import PinholeCamera

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
    # Each coordinate in a row of its own: points are located in half the time.
    points = torch.cat([cloud.T for cloud in clouds], dim=1).to(torch.float64).T
    pixels, inside = camera.locate(points, _NEAREST)
    seen = inside.numpy()
    # Pixel centres lie at integers: a cell begins half a pixel before its first.
    cells = np.floor((pixels.numpy()[seen] + 0.5) / _CELL).astype(np.int64)
    z = points[:, 2].numpy()[seen].astype(np.float32)
    ends = np.concatenate([[0], seen.cumsum()])[np.cumsum([0, *map(len, clouds)])]
    return [Silhouette(cells[begin:end], z[begin:end], camera, spacing) for begin, end in pairwise(ends.tolist())]


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
        if len(z) == 0:
            return
        middle = len(z) // 2
        self._gap = spacing * camera.fx / float(np.partition(z, middle)[middle])
        self._first = cells.min(axis=0)
        columns, rows = (cells.max(axis=0) - self._first + 1).tolist()
        # The least of the depths in each cell, and of their opposites: one look around finds nearest and farthest.
        column, row = (cells - self._first).T
        least = np.full(2 * rows * columns, _NONE, np.float32)
        place = 2 * (row * columns + column)
        np.minimum.at(least, place, z)
        np.minimum.at(least, place + 1, -z)
        self._least = least.reshape(rows, columns, 2)

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
        explained = np.zeros(depth.shape[1:], np.bool_)
        if len(self._z) == 0:
            return torch.from_numpy(explained)
        radius = max(round((margin + self._gap) / _CELL), 1)
        # Nothing is near beyond the radius: all that follows looks at this part of the image only.
        border = (radius, radius, radius, radius)
        wide = cv2.copyMakeBorder(self._least, *border, cv2.BORDER_CONSTANT, value=(_NONE, _NONE))
        around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        least = cv2.erode(wide, around)
        left, top = (self._first - radius).tolist()
        v, of_row = _pixels(top, len(wide), step, depth.shape[1])
        u, of_column = _pixels(left, wide.shape[1], step, depth.shape[2])
        # Columns first, while there are few rows.
        low, high = (
            cells.take(of_column, axis=1).take(of_row, axis=0)
            for cells in (least[..., 0] - tolerance, tolerance - least[..., 1])
        )
        z = depth[0].numpy()[v, u]  # NumPy compares in a third of torch's time
        fits = (z > low) & (z < high)
        if or_missing:
            fits |= (z <= 0) & (low < _NONE / 2)
        explained[v, u] = fits
        return torch.from_numpy(explained)

    def visible_fraction(self, depth: Tensor, tolerance: float) -> float:
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


def _pixels(first: int, count: int, step: int, size: int) -> tuple[slice, NDArray[np.int64]]:
    """Along one axis, which of every n-th pixel lie in so many cells from the first on, and in which of them."""
    begin, end = max(-(-first * _CELL // step), 0), min(-(-(first + count) * _CELL // step), size)
    return slice(begin, end), np.arange(begin, end) * step // _CELL - first
