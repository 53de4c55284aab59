"""Kernels of silhouettes; see `v3d_torch.objects.silhouette`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats, Floats32, Ints
from v3d_torch.kernels.camera import Bounds, Intrinsics, project_to_image
from v3d_torch.kernels.compiler import device, kernel


@kernel("(f8[:,:], f8, i8, UniTuple(f8, 13), UniTuple(f8, 6))")
def project_to_cells(
    points: Floats, min_depth: float, cell: int, intrinsics: Intrinsics, bounds: Bounds
) -> tuple[Ints, Floats32]:
    """Project a cloud to square cells of an image.

    Args:
        points: Points, camera frame, metres, (P, 3), in any memory order.
        min_depth: Points with at most this depth are not projected, metres.
        cell: Side of the cells, pixels.
        intrinsics: Intrinsics of the camera.
        bounds: Extent of the image.

    Returns:
        Cell (column, row), (Q, 2), and depth, metres, (Q,), of the points in the image.
    """
    cells, depths, count = np.empty((len(points), 2), np.int64), np.empty(len(points), np.float32), 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        inside, u, v = project_to_image(x, y, z, min_depth, intrinsics, bounds)
        if inside:
            # Pixel centres lie at integers, so a cell begins half a pixel before its first pixel centre.
            cells[count, 0], cells[count, 1] = math.floor((u + 0.5) / cell), math.floor((v + 0.5) / cell)
            depths[count] = z
            count += 1
    return cells[:count], depths[:count]


@kernel("(i8[:,::1], f4[::1], f4)")
def bin_depths(cells: Ints, z: Floats32, no_depth: float) -> tuple[Ints, Floats32]:
    """Minimum and maximum depth of the points in each cell.

    Args:
        cells: Cell (column, row) of each point, (Q, 2), at least one point.
        z: Depth of each point, metres, (Q,).
        no_depth: Depth of cells without points, metres.

    Returns:
        First cell (column, row), (2,), and minimum of z and of -z in each cell from there on, (rows, columns, 2).
    """
    first, last = cells[0].copy(), cells[0].copy()
    for i in range(len(cells)):
        for k in range(2):
            first[k], last[k] = min(first[k], cells[i, k]), max(last[k], cells[i, k])
    minima = np.full((last[1] - first[1] + 1, last[0] - first[0] + 1, 2), no_depth, np.float32)
    for i in range(len(cells)):
        cell = minima[cells[i, 1] - first[1], cells[i, 0] - first[0]]
        cell[0], cell[1] = min(cell[0], z[i]), min(cell[1], -z[i])
    return first, minima


@device
def _compare(z: Floats32, low: Floats32, high: Floats32, inside: Bools) -> None:
    for i in range(inside.size):
        inside[i] = (z[i] > low[i]) & (z[i] < high[i])


@device
def _add_missing(z: Floats32, low: Floats32, no_depth: float, inside: Bools) -> None:
    for i in range(inside.size):
        inside[i] |= (z[i] <= 0) & (low[i] < no_depth)


@kernel("(f4[:,:,::1], f4[:,::1], UniTuple(i8, 4), UniTuple(i8, 4), f4, f4, b1[:,::1])")
def select_pixels(
    minima: Floats32, depth: Floats32, box: tuple[int, int, int, int], grid: tuple[int, int, int, int],
    tolerance: float, no_depth: float, mask: Bools,
) -> None:  # fmt: skip
    """Select the pixels of a box whose depth lies within the range of their cell.

    Args:
        minima: Minimum of z and of -z around each cell, metres, (rows, columns, 2).
        depth: Depth of every n-th pixel, metres, (h, w); 0 = no measurement.
        box: First and last row (exclusive), first and last column (exclusive) of the box.
        grid: Row and column of the first cell, side of the cells in pixels, stride n.
        tolerance: Tolerance of the depth, metres.
        no_depth: Pixels without depth are selected if the lower limit is below this depth, metres; 0 to select none.
        mask: Selected pixels, (h, w); written in the box.
    """
    begin, end, left, right = box
    top, first, cell, stride = grid
    low, high = np.empty(right - left, np.float32), np.empty(right - left, np.float32)
    columns = np.arange(left, right) * stride // cell - first
    previous = -1
    for v in range(begin, end):
        row = v * stride // cell - top
        if row != previous:
            for i in range(len(columns)):
                low[i] = minima[row, columns[i], 0] - tolerance
                high[i] = tolerance - minima[row, columns[i], 1]
            previous = row
        z, inside = depth[v, left:right], mask[v, left:right]
        _compare(z, low, high, inside)
        if no_depth > 0:
            _add_missing(z, low, no_depth, inside)
