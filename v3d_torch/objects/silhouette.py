"""Silhouette of a point cloud: pixels near the projected points whose depth agrees with the points.

A segmentation network draws masks at a quarter of the resolution of its input: it cuts off hands and includes parts of
the wall. The outlier-free cloud of an object gives the range of depths that belong to the object at each pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import silhouette as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.kernels.masks import Box
from v3d_torch.objects.crops import Crop, box_of
from v3d_torch.objects.dilation import ellipse, ellipse_heights

CELL_SIZE = 4
"""Side of the cells that collect the depths of a cloud, pixels: smaller than a cell of the network's masks, 6 pixels
by default."""

DEPTH_TOLERANCE = 0.2
"""Tolerance of the depth around predicted points, metres: arms and legs swing by this much between two frames."""

_NO_DEPTH = 1e6
"""Depth of cells without points, metres: farther than any measurement."""

_MIN_DEPTH = 0.1
"""Minimum depth of projected points, metres."""

Minima = NDArray[np.float32]
"""Minimum of z and of -z in or around each cell, metres, shape (rows, columns, 2)."""


class ProjectedCloud(NamedTuple):
    """Points of a cloud that are in the image.

    Attributes:
        cells: Cell (column, row) of each point, int64, shape :math:`(P, 2)`.
        z: Depth of each point, metres, float32, shape :math:`(P,)`.
        minima: Minimum of z and of -z in each cell from the first one on, metres, shape :math:`(h, w, 2)`.
        first: First cell (column, row).
        median_depth: Median of the depths, metres; 0 without points.
    """

    cells: NDArray[np.int64]
    z: NDArray[np.float32]
    minima: Minima
    first: tuple[int, int]
    median_depth: float


def silhouettes(clouds: Sequence[Tensor], camera: PinholeCamera, spacing: float) -> list[Silhouette]:
    """Project several clouds into an image.

    Args:
        clouds: Point clouds, camera frame, metres, each of shape :math:`(P, 3)`.
        camera: Camera of the image.
        spacing: Spacing of the points, metres: gaps of this size are closed.

    Returns:
        Silhouette of each cloud.
    """
    return [Silhouette(_project(cloud, camera), camera, spacing) for cloud in clouds]


def _project_compiled(cloud: Tensor, camera: PinholeCamera) -> ProjectedCloud:
    points = cloud.to(torch.float64).numpy()
    return ProjectedCloud(
        *kernels.project_to_cells(points, _MIN_DEPTH, CELL_SIZE, _NO_DEPTH, camera.intrinsics, camera.bounds)
    )


@compiled_by(_project_compiled)
def _project(cloud: Tensor, camera: PinholeCamera) -> ProjectedCloud:
    """Project a cloud (P, 3) into an image."""
    points = cloud.detach().to(torch.float64)
    pixels, inside = camera.project_to_image(points, _MIN_DEPTH)
    # Pixel centres lie at integers, so a cell begins half a pixel before its first pixel centre.
    cells = np.floor((pixels[inside].numpy() + 0.5) / CELL_SIZE).astype(np.int64)
    z = points[inside, 2].numpy().astype(np.float32)
    if len(z) == 0:
        return ProjectedCloud(cells, z, np.zeros((0, 0, 2), np.float32), (0, 0), 0.0)
    first = cells.min(axis=0)
    columns, rows = (cells.max(axis=0) - first + 1).tolist()
    column, row = (cells - first).T
    minima = np.full((rows, columns, 2), _NO_DEPTH, np.float32)
    np.minimum.at(minima, (row, column, 0), z)
    np.minimum.at(minima, (row, column, 1), -z)
    middle = len(z) // 2
    return ProjectedCloud(cells, z, minima, (int(first[0]), int(first[1])), float(np.partition(z, middle)[middle]))


def _minima_around_compiled(minima: Minima, radius: int) -> Minima:
    heights = ellipse_heights(radius)
    return NotImplemented if heights is None else kernels.minima_around(minima, heights, _NO_DEPTH)


@compiled_by(_minima_around_compiled)
def _minima_around(minima: Minima, radius: int) -> Minima:
    """Return the minima in a circle around each cell, also around the empty cells within the radius of the others."""
    border = (radius, radius, radius, radius)
    padded = cv2.copyMakeBorder(minima, *border, cv2.BORDER_CONSTANT, value=(_NO_DEPTH, _NO_DEPTH))
    return np.asarray(cv2.erode(padded, ellipse(radius)), np.float32)


def _select_pixels_compiled(
    minima: Minima,
    first: tuple[int, int],
    depth: Tensor,
    box: Box,
    tolerance: float,
    stride: int,
    include_missing: bool,
) -> Tensor:
    if depth.dtype != torch.float32:
        return NotImplemented
    no_depth = _NO_DEPTH / 2 if include_missing else 0.0
    mask = kernels.select_pixels(minima, first, to_array(depth[0]), box, (CELL_SIZE, stride), tolerance, no_depth)
    return torch.from_numpy(mask)


@compiled_by(_select_pixels_compiled)
def _select_pixels(
    minima: Minima,
    first: tuple[int, int],
    depth: Tensor,
    box: Box,
    tolerance: float,
    stride: int,
    include_missing: bool,
) -> Tensor:
    """Select the pixels whose depth lies within the range of their cell.

    Args:
        minima: Minimum of z and of -z around each cell, metres, shape (rows, columns, 2).
        first: First cell (column, row).
        depth: Depth of every n-th pixel, metres, shape (1, H, W); 0 = no measurement.
        box: Rows and columns of ``depth`` in which pixels are selected.
        tolerance: Tolerance of the depth, metres.
        stride: Step n between the pixels of ``depth``.
        include_missing: Include pixels without depth in cells near points.

    Returns:
        Mask of the box, bool, shape (h, w).
    """
    (left, top), (top_row, bottom_row, left_column, right_column) = first, box
    mask = np.zeros((bottom_row - top_row, right_column - left_column), np.bool_)
    v, u = (
        _pixels_of_cells(top, len(minima), stride, top_row, bottom_row),
        _pixels_of_cells(left, minima.shape[1], stride, left_column, right_column),
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
    mask[v.start - top_row : v.stop - top_row, u.start - left_column : u.stop - left_column] = inside
    return torch.from_numpy(mask)


def _count_points_compiled(
    cells: NDArray[np.int64], z: NDArray[np.float32], depth: Tensor, tolerance: float
) -> tuple[int, int]:
    if depth.dtype != torch.float32:
        return NotImplemented
    return kernels.count_points(cells, z, to_array(depth[0]), CELL_SIZE, tolerance)


@compiled_by(_count_points_compiled)
def _count_points(cells: NDArray[np.int64], z: NDArray[np.float32], depth: Tensor, tolerance: float) -> tuple[int, int]:
    """Count the points with the measured depth, and those in front of it, at the centre of the cell of each point.

    Args:
        cells: Cell (column, row) of each point, shape (P, 2).
        z: Depth of each point, metres, shape (P,).
        depth: Measured depth, metres, shape (1, H, W); 0 = no measurement.
        tolerance: Tolerance of the depth, metres.
    """
    _, height, width = depth.shape
    u, v = np.minimum(CELL_SIZE * cells + CELL_SIZE // 2, (width - 1, height - 1)).T
    difference = depth[0].numpy()[v, u] - z
    return int((np.abs(difference) < tolerance).sum()), int((difference > tolerance).sum())


class Silhouette:
    """Projection of a cloud into an image.

    Args:
        projected: Points of the cloud that are in the image.
        camera: Camera of the image.
        spacing: Spacing of the points, metres.
    """

    def __init__(self, projected: ProjectedCloud, camera: PinholeCamera, spacing: float) -> None:
        self._projected = projected
        self._gap = spacing * camera.fx / projected.median_depth if len(projected.z) else 0.0
        # Minima of z and of -z give the nearest and the farthest depth around a cell.
        self._around: dict[int, Minima] = {}  # by radius

    def mask(
        self,
        depth: Tensor,
        margin: int,
        tolerance: float,
        *,
        stride: int = 1,
        include_missing: bool = False,
        crop: Crop | None = None,
    ) -> Tensor:
        """Return the pixels near the points whose depth lies within the depth range of the surrounding points.

        Args:
            depth: Depth of every n-th pixel, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            margin: Distance from the outermost points up to which pixels are included, pixels.
            tolerance: Tolerance of the depth in front of and behind the surrounding points, metres.
            stride: Step n between the pixels of ``depth``.
            include_missing: Include pixels near the points that have no depth.
            crop: Rows and columns of ``depth`` for which the mask is computed; None for all.

        Returns:
            Mask of these pixels, bool, shape :math:`(h, w)`; empty if no point is in the image.
        """
        box = (0, depth.shape[1], 0, depth.shape[2]) if crop is None else box_of(crop, depth.shape[1:])
        if len(self._projected.z) == 0:
            return torch.zeros(box[1] - box[0], box[3] - box[2], dtype=torch.bool)
        radius = max(round((margin + self._gap) / CELL_SIZE), 1)
        if radius not in self._around:
            self._around[radius] = _minima_around(self._projected.minima, radius)
        left, top = self._projected.first
        first = left - radius, top - radius
        return _select_pixels(self._around[radius], first, depth, box, tolerance, stride, include_missing)

    def visible_fraction(self, depth: Tensor) -> float:
        """Return the fraction of projected points whose depth is the measured depth.

        Args:
            depth: Measured depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.

        Returns:
            Fraction of the points, from 0 to 1; 0 if no point is in the image.
        """
        cells, z = self._projected.cells, self._projected.z
        return _count_points(cells, z, depth, DEPTH_TOLERANCE)[0] / max(len(z), 1)

    def count_vacated(self, depth: Tensor) -> int:
        """Count the projected points behind which a surface is measured, so that their place is empty.

        Args:
            depth: Measured depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.
        """
        return _count_points(self._projected.cells, self._projected.z, depth, DEPTH_TOLERANCE)[1]


def _pixels_of_cells(first: int, count: int, stride: int, least: int, end: int) -> slice:
    """Return the range of every n-th pixel of ``count`` cells that start with the cell ``first``, along one axis.

    The range lies within the pixels from ``least`` to ``end`` (exclusive).
    """
    begin, end = max(-(-first * CELL_SIZE // stride), least), min(-(-(first + count) * CELL_SIZE // stride), end)
    return slice(begin, max(begin, end))
