"""Kernels of silhouettes; see `v3d_torch.objects.silhouette`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Bytes, Floats, Floats32, Ints
from v3d_torch.kernels.camera import Bounds, Intrinsics, project_to_image
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.masks import Box
from v3d_torch.kernels.nearest_depth import lower


@device
def _bin_depths(cells: Ints, z: Floats32, first: tuple[int, int], size: tuple[int, int], no_depth: float) -> Floats32:
    """Minimum of z and of -z of the points in each cell from the first one on, (rows, columns, 2)."""
    minima = np.full((size[1], size[0], 2), no_depth, np.float32)
    for i in range(len(cells)):
        cell = minima[cells[i, 1] - first[1], cells[i, 0] - first[0]]
        cell[0], cell[1] = min(cell[0], z[i]), min(cell[1], -z[i])
    return minima


@kernel("(f8[:,:], f8, i8, f4, UniTuple(f8, 13), UniTuple(f8, 6))")
def project_to_cells(
    points: Floats, min_depth: float, cell: int, no_depth: float, intrinsics: Intrinsics, bounds: Bounds
) -> tuple[Ints, Floats32, Floats32, tuple[int, int], float]:
    """Project a cloud to square cells of an image.

    Args:
        points: Points, camera frame, metres, (P, 3), in any memory order.
        min_depth: Points with at most this depth are not projected, metres.
        cell: Side of the cells, pixels.
        no_depth: Depth of cells without points, metres.
        intrinsics: Intrinsics of the camera.
        bounds: Extent of the image.

    Returns:
        Cell (column, row), (Q, 2), and depth, metres, (Q,), of the points in the image; minimum of z and of -z in each
        cell from the first one on, (rows, columns, 2); first cell (column, row); median depth. No cell, and 0, without
        a point in the image.
    """
    cells, depths, count = np.empty((len(points), 2), np.int64), np.empty(len(points), np.float32), 0
    left, top, right, bottom = 0, 0, -1, -1
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        inside, u, v = project_to_image(x, y, z, min_depth, intrinsics, bounds)
        if inside:
            # Pixel centres lie at integers, so a cell begins half a pixel before its first pixel centre.
            column, row = math.floor((u + 0.5) / cell), math.floor((v + 0.5) / cell)
            if count == 0:
                left, top, right, bottom = column, row, column, row
            left, top, right, bottom = min(left, column), min(top, row), max(right, column), max(bottom, row)
            cells[count, 0], cells[count, 1], depths[count] = column, row, z
            count += 1
    cells, depths, first = cells[:count], depths[:count], (left, top)
    minima = _bin_depths(cells, depths, first, (right - left + 1, bottom - top + 1), no_depth)
    median = float(np.partition(depths, count // 2)[count // 2]) if count else 0.0
    return cells, depths, minima, first, median


@kernel("(f4[:,:,::1], u1[::1], f4)")
def minima_around(minima: Floats32, heights: Bytes, no_depth: float) -> Floats32:
    """Minima in a convex, symmetric shape around each cell, also around the empty cells beside the given ones.

    Args:
        minima: Minimum of z and of -z in each cell, metres, (rows, columns, 2).
        heights: Height of the shape above its centre, in each column from the centre to the right, cells, (r + 1,).
        no_depth: Depth of the cells beside, metres.

    Returns:
        Minimum of z and of -z around each cell, metres, (rows + 2 r, columns + 2 r, 2).
    """
    (rows, columns, _), radius = minima.shape, len(heights) - 1
    # All rows are one array: a loop over it is faster than one over each row. A shift by up to the radius moves only
    # cells beside the given ones to another row, and these have no depth.
    border, width = 2 * radius, 2 * (columns + 2 * radius)
    padded = np.full((rows, width), no_depth, np.float32)
    padded[:, border : width - border] = minima.reshape(rows, 2 * columns)
    values, around = padded.ravel(), np.full((rows + 2 * radius) * width, no_depth, np.float32)
    # Minimum in a column of cells, from a height above each cell to the same height below it.
    in_column = np.full(around.size + 2 * border, no_depth, np.float32)
    for height in range(radius + 1):
        above, below = (radius - height) * width, (radius + height) * width
        lower(values, in_column[border + above : border + above + values.size])
        lower(values, in_column[border + below : border + below + values.size])
        for x in range(2 * radius + 1):
            if heights[abs(x - radius)] == height:
                lower(in_column[2 * x + above : 2 * x + below + values.size], around[above : below + values.size])
    return around.reshape(rows + 2 * radius, columns + 2 * radius, 2)


@device
def _compare(z: Floats32, low: Floats32, high: Floats32, inside: Bools) -> None:
    for i in range(inside.size):
        inside[i] = (z[i] > low[i]) & (z[i] < high[i])


@device
def _add_missing(z: Floats32, low: Floats32, no_depth: float, inside: Bools) -> None:
    for i in range(inside.size):
        inside[i] |= (z[i] <= 0) & (low[i] < no_depth)


@kernel("(f4[:,:,::1], UniTuple(i8, 2), f4[:,::1], UniTuple(i8, 4), UniTuple(i8, 2), f4, f4)")
def select_pixels(
    minima: Floats32, first: tuple[int, int], depth: Floats32, box: Box, steps: tuple[int, int], tolerance: float,
    no_depth: float,
) -> Bools:  # fmt: skip
    """Select the pixels whose depth lies within the range of their cell.

    Args:
        minima: Minimum of z and of -z around each cell, metres, (rows, columns, 2).
        first: Column and row of the first cell.
        depth: Depth of every n-th pixel, metres, (H, W); 0 = no measurement.
        box: Rows and columns of ``depth`` in which pixels are selected.
        steps: Side of the cells in pixels, and n.
        tolerance: Tolerance of the depth, metres.
        no_depth: Pixels without depth are selected if the lower limit is below this depth, metres; 0 to select none.

    Returns:
        Selected pixels of the box, (h, w).
    """
    (left, top), (cell, stride), (top_row, bottom_row, left_column, right_column) = first, steps, box
    mask = np.zeros((bottom_row - top_row, right_column - left_column), np.bool_)
    begin = max(-(-left * cell // stride), left_column)
    end = min(-(-(left + minima.shape[1]) * cell // stride), right_column)
    columns = np.arange(begin, max(begin, end)) * stride // cell - left
    low, high, previous = np.empty(len(columns), np.float32), np.empty(len(columns), np.float32), -1
    first_row, last_row = max(-(-top * cell // stride), top_row), -(-(top + len(minima)) * cell // stride)
    for v in range(first_row, min(last_row, bottom_row)):
        row = v * stride // cell - top
        if row != previous:
            for i in range(len(columns)):
                low[i] = minima[row, columns[i], 0] - tolerance
                high[i] = tolerance - minima[row, columns[i], 1]
            previous = row
        z = depth[v, begin : begin + len(columns)]
        inside = mask[v - top_row, begin - left_column : begin - left_column + len(columns)]
        _compare(z, low, high, inside)
        if no_depth > 0:
            _add_missing(z, low, no_depth, inside)
    return mask


@kernel("(i8[:,::1], f4[::1], f4[:,::1], i8, f4)")
def count_points(cells: Ints, z: Floats32, depth: Floats32, cell: int, tolerance: float) -> tuple[int, int]:
    """Count the points with the measured depth, and those in front of it.

    Args:
        cells: Cell (column, row) of each point, (Q, 2).
        z: Depth of each point, metres, (Q,).
        depth: Measured depth, metres, (H, W); 0 = no measurement. The pixel in the middle of a cell is read.
        cell: Side of the cells, pixels.
        tolerance: Tolerance of the depth, metres.
    """
    agreeing, in_front = 0, 0
    for i in range(len(z)):
        u = min(cell * cells[i, 0] + cell // 2, depth.shape[1] - 1)
        v = min(cell * cells[i, 1] + cell // 2, depth.shape[0] - 1)
        difference = depth[v, u] - z[i]
        agreeing += abs(difference) < tolerance
        in_front += difference > tolerance
    return agreeing, in_front
