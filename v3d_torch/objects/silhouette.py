"""Silhouette of a point cloud: pixels near the projected points whose depth agrees with the points.

A segmentation network draws masks at a quarter of the resolution of its input: it cuts off hands and includes parts of
the wall. The outlier-free cloud of an object gives the range of depths that belong to the object at each pixel.
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
from v3d_torch.kernels import silhouette as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.objects.dilation import ellipse

CELL_SIZE = 4
"""Side of the cells that collect the depths of a cloud, pixels: smaller than a cell of the network's masks, 6 pixels
by default."""

DEPTH_TOLERANCE = 0.2
"""Tolerance of the depth around predicted points, metres: arms and legs swing by this much between two frames."""

_NO_DEPTH = 1e6
"""Depth of cells without points, metres: farther than any measurement."""

_MIN_DEPTH = 0.1
"""Minimum depth of projected points, metres."""

ProjectedCells = tuple[NDArray[np.int64], NDArray[np.float32]]
"""Cell (column, row), shape (P, 2), and depth, metres, shape (P,), of the points of a cloud that are in the image."""

Minima = NDArray[np.float32]
"""Minimum of z and of -z in or around each cell, metres, shape (rows, columns, 2)."""


def silhouettes(clouds: Sequence[Tensor], camera: PinholeCamera, spacing: float) -> list[Silhouette]:
    """Project several clouds into an image at once.

    Args:
        clouds: Point clouds, camera frame, metres, each of shape :math:`(P, 3)`.
        camera: Camera of the image.
        spacing: Spacing of the points, metres: gaps of this size are closed.

    Returns:
        Silhouette of each cloud.
    """
    return [Silhouette(cells, z, camera, spacing) for cells, z in _project_to_cells(clouds, camera)]


def _project_to_cells_compiled(clouds: Sequence[Tensor], camera: PinholeCamera) -> list[ProjectedCells]:
    if any(cloud.requires_grad for cloud in clouds):
        return NotImplemented
    points = [cloud.to(torch.float64).numpy() for cloud in clouds]
    return [kernels.project_to_cells(each, _MIN_DEPTH, CELL_SIZE, camera.intrinsics, camera.bounds) for each in points]


@compiled_by(_project_to_cells_compiled)
def _project_to_cells(clouds: Sequence[Tensor], camera: PinholeCamera) -> list[ProjectedCells]:
    """Project several clouds (P, 3) into an image at once."""
    if not clouds:
        return []
    # One contiguous row per coordinate is faster to project.
    points = torch.cat([cloud.T for cloud in clouds], dim=1).to(torch.float64).T
    pixels, inside = camera.project_to_image(points, _MIN_DEPTH)
    projected = inside.numpy()
    # Pixel centres lie at integers, so a cell begins half a pixel before its first pixel centre.
    cells = np.floor((pixels.numpy()[projected] + 0.5) / CELL_SIZE).astype(np.int64)
    z = points[:, 2].numpy()[projected].astype(np.float32)
    ends = np.concatenate([[0], projected.cumsum()])[np.cumsum([0, *map(len, clouds)])]
    return [(cells[begin:end], z[begin:end]) for begin, end in pairwise(ends.tolist())]


def _bin_depths_compiled(cells: NDArray[np.int64], z: NDArray[np.float32]) -> tuple[NDArray[np.int64], Minima]:
    return kernels.bin_depths(cells, z, _NO_DEPTH)


@compiled_by(_bin_depths_compiled)
def _bin_depths(cells: NDArray[np.int64], z: NDArray[np.float32]) -> tuple[NDArray[np.int64], Minima]:
    """Return the first cell (column, row), and the minima of z and of -z in each cell from there on."""
    first = cells.min(axis=0)
    columns, rows = (cells.max(axis=0) - first + 1).tolist()
    column, row = (cells - first).T
    minima = np.full(2 * rows * columns, _NO_DEPTH, np.float32)
    index = 2 * (row * columns + column)
    np.minimum.at(minima, index, z)
    np.minimum.at(minima, index + 1, -z)
    return first, minima.reshape(rows, columns, 2)


def _select_pixels_compiled(
    minima: Minima, first: NDArray[np.int64], depth: Tensor, tolerance: float, stride: int, include_missing: bool
) -> Tensor:
    if depth.dtype != torch.float32:
        return NotImplemented
    _, height, width = depth.shape
    left, top = first.tolist()
    rows, columns = (
        _pixels_of_cells(top, len(minima), stride, height),
        _pixels_of_cells(left, minima.shape[1], stride, width),
    )
    mask = np.zeros((height, width), np.bool_)
    box, grid = (rows.start, rows.stop, columns.start, columns.stop), (top, left, CELL_SIZE, stride)
    no_depth = _NO_DEPTH / 2 if include_missing else 0.0
    kernels.select_pixels(minima, to_array(depth[0]), box, grid, tolerance, no_depth, mask)
    return torch.from_numpy(mask)


@compiled_by(_select_pixels_compiled)
def _select_pixels(
    minima: Minima, first: NDArray[np.int64], depth: Tensor, tolerance: float, stride: int, include_missing: bool
) -> Tensor:
    """Select the pixels whose depth lies within the range of their cell.

    Args:
        minima: Minimum of z and of -z around each cell, metres, shape (rows, columns, 2).
        first: First cell (column, row).
        depth: Depth of every n-th pixel, metres, shape (1, h, w); 0 = no measurement.
        tolerance: Tolerance of the depth, metres.
        stride: Step n between the pixels of ``depth``.
        include_missing: Include pixels without depth in cells near points.

    Returns:
        Mask, bool, shape (h, w).
    """
    mask = np.zeros(depth.shape[1:], np.bool_)
    left, top = first.tolist()
    v, u = (
        _pixels_of_cells(top, len(minima), stride, depth.shape[1]),
        _pixels_of_cells(left, minima.shape[1], stride, depth.shape[2]),
    )
    cell_rows = np.arange(v.start, v.stop) * stride // CELL_SIZE - top
    cell_columns = np.arange(u.start, u.stop) * stride // CELL_SIZE - left
    # Expand the cells to pixels: columns first, while there are few rows.
    low, high = (
        bound.take(cell_columns, axis=1).take(cell_rows, axis=0)
        for bound in (minima[..., 0] - tolerance, tolerance - minima[..., 1])
    )
    z = depth[0].numpy()[v, u]  # NumPy compares faster here than torch
    inside = (z > low) & (z < high)
    if include_missing:
        inside |= (z <= 0) & (low < _NO_DEPTH / 2)
    mask[v, u] = inside
    return torch.from_numpy(mask)


class Silhouette:
    """Projection of a cloud into an image.

    Args:
        cells: Cell (column, row) of each projected point, int64, shape :math:`(P, 2)`.
        z: Depth of each projected point, metres, float32, shape :math:`(P,)`.
        camera: Camera of the image.
        spacing: Spacing of the points, metres.
    """

    def __init__(self, cells: NDArray[np.int64], z: NDArray[np.float32], camera: PinholeCamera, spacing: float) -> None:
        self._cells, self._z = cells, z
        if len(z) == 0:
            return
        middle = len(z) // 2
        median_depth = float(np.partition(z, middle)[middle])
        self._gap = spacing * camera.fx / median_depth
        # Minimum of z and of -z in each cell: one erosion then finds the nearest and the farthest depth around a cell.
        self._first_cell, self._minima = _bin_depths(cells, z)
        self._eroded: dict[int, Minima] = {}  # by radius

    def mask(
        self,
        depth: Tensor,
        margin: int,
        tolerance: float,
        *,
        stride: int = 1,
        include_missing: bool = False,
        origin: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """Return the pixels near the points whose depth lies within the depth range of the surrounding points.

        Args:
            depth: Depth of every n-th pixel of the image or of a part of it, metres, shape :math:`(1, h, w)`; 0 = no
                measurement.
            margin: Distance from the outermost points up to which pixels are included, pixels.
            tolerance: Tolerance of the depth in front of and behind the surrounding points, metres.
            stride: Step n between the pixels of ``depth``.
            include_missing: Include pixels near the points that have no depth.
            origin: Row and column of the image at which ``depth`` begins, multiples of the stride and of `CELL_SIZE`.

        Returns:
            Mask of the pixels of ``depth``, bool, shape :math:`(h, w)`; empty if no point is in the image.
        """
        if len(self._z) == 0:
            return torch.zeros(depth.shape[1:], dtype=torch.bool)
        radius = max(round((margin + self._gap) / CELL_SIZE), 1)
        if radius not in self._eroded:
            self._eroded[radius] = self._erode(radius)
        top, left = origin
        first = self._first_cell - radius - (left // CELL_SIZE, top // CELL_SIZE)
        return _select_pixels(self._eroded[radius], first, depth, tolerance, stride, include_missing)

    def _erode(self, radius: int) -> Minima:
        """Return the minima around each cell, also around the empty cells within the radius of the others."""
        border = (radius, radius, radius, radius)
        padded = cv2.copyMakeBorder(self._minima, *border, cv2.BORDER_CONSTANT, value=(_NO_DEPTH, _NO_DEPTH))
        return np.asarray(cv2.erode(padded, ellipse(radius)), np.float32)

    def visible_fraction(self, depth: Tensor) -> float:
        """Return the fraction of projected points whose depth is the measured depth.

        Args:
            depth: Measured depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.

        Returns:
            Fraction of the points, from 0 to 1; 0 if no point is in the image.
        """
        if len(self._z) == 0:
            return 0.0
        return float((np.abs(self._measured_depth(depth) - self._z) < DEPTH_TOLERANCE).mean())

    def count_vacated(self, depth: Tensor) -> int:
        """Count the projected points behind which a surface is measured, so that their place is empty.

        Args:
            depth: Measured depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.
        """
        return 0 if len(self._z) == 0 else int((self._measured_depth(depth) - self._z > DEPTH_TOLERANCE).sum())

    def _measured_depth(self, depth: Tensor) -> NDArray[np.float32]:
        """Return the measured depth at the centre of the cell of each projected point, metres, shape (P,)."""
        _, height, width = depth.shape
        u, v = np.minimum(CELL_SIZE * self._cells + CELL_SIZE // 2, (width - 1, height - 1)).T
        return depth[0].numpy()[v, u]


def _pixels_of_cells(first: int, count: int, stride: int, size: int) -> slice:
    """Return the range of every n-th pixel of ``count`` cells that start with the cell ``first``, along one axis."""
    begin, end = max(-(-first * CELL_SIZE // stride), 0), min(-(-(first + count) * CELL_SIZE // stride), size)
    return slice(begin, max(begin, end))
