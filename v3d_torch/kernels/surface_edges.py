"""Kernels of the edges of surfaces; see `v3d_torch.objects.surface_edges`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats32
from v3d_torch.kernels.compiler import device, kernel

_MAX = np.finfo(np.float32).max
"""Minimum depth of pixels without measurement: larger than any measured depth."""


@device
def _extend(depth: Floats32, nearest: Floats32, farthest: Floats32) -> None:
    """Update the minimum and the maximum depth of each column, (W,), with one row."""
    for x in range(nearest.size):
        nearest[x] = depth[x] if (depth[x] > 0) & (depth[x] < nearest[x]) else nearest[x]
        farthest[x] = depth[x] if depth[x] > farthest[x] else farthest[x]


@kernel("(f4[:,::1], i8, f4)")
def find_smooth_pixels(depth: Floats32, stride: int, edge_ratio: float) -> Bools:
    """Check at every n-th pixel whether the depth within half the stride of it varies by less than a fraction of it.

    Args:
        depth: Depth, metres, (H, W); 0 = no measurement.
        stride: Step n between the pixels.
        edge_ratio: Largest variation of the depth, as a fraction of the depth.

    Returns:
        Smooth pixels, (h, w).
    """
    height, width = depth.shape
    before, after = (stride + 1) // 2, stride // 2
    smooth = np.zeros((-(-height // stride), -(-width // stride)), np.bool_)
    nearest, farthest = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(len(smooth)):
        v = row * stride
        nearest[:], farthest[:] = np.float32(_MAX), np.float32(0)
        for y in range(max(v - before, 0), min(v + after + 1, height)):
            _extend(depth[y], nearest, farthest)
        for column in range(smooth.shape[1]):
            u = column * stride
            low, high = nearest[u], farthest[u]
            for x in range(max(u - before, 0), min(u + after + 1, width)):
                low, high = min(low, nearest[x]), max(high, farthest[x])
            smooth[row, column] = (depth[v, u] > 0) & (high - low < edge_ratio * depth[v, u])
    return smooth


@device
def _add_bends(before: Floats32, centre: Floats32, after: Floats32, min_bend: float, edges: Bools) -> None:
    for i in range(edges.size):
        edges[i] |= before[i] + after[i] - np.float32(2) * centre[i] > min_bend


@kernel("(f4[:,:], i8, i8, f4)")
def find_concave_edges(depth: Floats32, reach: int, diagonal_reach: int, min_bend: float) -> Bools:
    """Find the cells at which the depth bends towards the camera along rows, columns or diagonals.

    Args:
        depth: Depth of each cell, metres, (h, w); 0 = no measurement.
        reach: Distance at which a bend is measured along rows and columns, cells.
        diagonal_reach: Distance along both on a diagonal, cells.
        min_bend: Minimum second difference of the inverse depth, 1/m.

    Returns:
        Cells on concave edges, (h, w).
    """
    height, width = depth.shape
    inverse, edges = np.empty((height, width), np.float32), np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            inverse[y, x] = np.float32(1) / depth[y, x] if depth[y, x] > 0 else np.float32(math.nan)
    r, d = reach, diagonal_reach
    for y in range(height):
        row = inverse[y]
        if width > 2 * r:
            _add_bends(row[: width - 2 * r], row[r : width - r], row[2 * r :], min_bend, edges[y, r : width - r])
        if r <= y < height - r:
            _add_bends(inverse[y - r], row, inverse[y + r], min_bend, edges[y])
        if d <= y < height - d and width > 2 * d:
            above, below, centre, inner = inverse[y - d], inverse[y + d], row[d : width - d], edges[y, d : width - d]
            _add_bends(above[: width - 2 * d], centre, below[2 * d :], min_bend, inner)
            _add_bends(above[2 * d :], centre, below[: width - 2 * d], min_bend, inner)
    return edges
