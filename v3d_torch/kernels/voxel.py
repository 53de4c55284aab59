"""Kernel of the voxel pooling; see `v3d_torch.geometry.voxel`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats32, Ints
from v3d_torch.kernels.compiler import kernel
from v3d_torch.kernels.radix_sort import argsort


@kernel("(f4[:,::1], f4, f8)")
def pool_voxels(points: Floats32, size: np.float32, max_voxels: float) -> tuple[Floats32, Ints, Ints]:
    """Mean point of each occupied voxel of one cloud, sorted by x, then y, then z.

    Args:
        points: Points, metres, (N, 3).
        size: Side of a voxel, metres.
        max_voxels: Upper bound of the bounding box, voxels.

    Returns:
        Means (M, 3), number of points in each voxel (M,), index of each point's voxel (N,). No voxels if the bounding
        box is too large or a point is not finite.
    """
    count = len(points)
    cells, low, high = np.empty((count, 3)), np.full(3, np.inf), np.full(3, -np.inf)  # double, to be subtracted
    finite = True
    for i in range(count):
        for axis in range(3):
            cell = np.float64(np.floor(points[i, axis] / size))
            finite &= np.isfinite(cell)
            cells[i, axis], low[axis], high[axis] = cell, min(low[axis], cell), max(high[axis], cell)
    sums, sizes, voxels = np.zeros((count, 3)), np.zeros(count, np.int64), np.empty(count, np.int64)
    sides = high - low + 1
    if count == 0 or not finite or not sides[0] * sides[1] * sides[2] < max_voxels:
        return np.empty((0, 3), np.float32), sizes[:0], voxels
    keys, (side_y, side_z) = np.empty(count, np.int64), (np.int64(sides[1]), np.int64(sides[2]))
    for i in range(count):
        x, y, z = cells[i, 0] - low[0], cells[i, 1] - low[1], cells[i, 2] - low[2]
        keys[i] = (np.int64(x) * side_y + np.int64(y)) * side_z + np.int64(z)
    last, voxel = np.int64(-1), -1
    for i in argsort(keys, keys.max()):
        voxel += keys[i] != last
        last, voxels[i] = keys[i], voxel
        sizes[voxel] += 1
        for axis in range(3):
            sums[voxel, axis] += points[i, axis]
    means = np.empty((voxel + 1, 3), np.float32)
    for k in range(voxel + 1):
        for axis in range(3):
            means[k, axis] = sums[k, axis] / sizes[k]
    return means, sizes[: voxel + 1], voxels
