"""Kernel of the minimum depth around pixels; see `v3d_torch.objects.depth_view`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats32
from v3d_torch.kernels.compiler import device, kernel

_MAX = np.finfo(np.float32).max
"""Depth of pixels without measurement: larger than any measured depth."""


@device
def _read(depth: Floats32, row: Floats32) -> None:
    """Copy a row; pixels without depth are set to the largest number."""
    for x in range(row.size):
        row[x] = depth[x] if depth[x] > 0 else np.float32(_MAX)


@device
def _min(a: Floats32, b: Floats32, minimum: Floats32) -> None:
    for x in range(minimum.size):
        minimum[x] = a[x] if a[x] < b[x] else b[x]


@device
def lower(a: Floats32, minimum: Floats32) -> None:
    """Update a minimum in place; in one loop with `_min`, arrays could overlap and would not be vectorised."""
    for x in range(minimum.size):
        minimum[x] = a[x] if a[x] < minimum[x] else minimum[x]


@device
def _write(a: Floats32, b: Floats32, depth: Floats32, nearest: Floats32) -> None:
    for x in range(nearest.size):
        nearest[x] = (a[x] if a[x] < b[x] else b[x]) if depth[x] > 0 else np.float32(0)


@kernel("(f4[:,::1], i8)")
def nearest_depth(depth: Floats32, radius: int) -> Floats32:
    """Minimum depth in a square around each pixel (van Herk's algorithm along columns).

    Args:
        depth: Depth, metres, (H, W); 0 = no measurement.
        radius: Radius of the square, pixels: its side is 2 radius + 1.

    Returns:
        Depth, metres, (H, W); 0 for a pixel without measurement.
    """
    height, width = depth.shape
    size = 2 * radius + 1
    row, wider = np.empty(width + 2 * radius, np.float32), np.empty(width + 2 * radius, np.float32)
    # Minima along rows; the rows above and below the image have no measurement.
    minima = np.full((-(-(height + 2 * radius) // size) * size + size, width), np.float32(_MAX), np.float32)
    for y in range(height):
        row[:radius], row[radius + width :] = np.float32(_MAX), np.float32(_MAX)
        _read(depth[y], row[radius : radius + width])
        window = 1  # row[x] is the minimum of this many pixels from x on
        while 2 * window <= size:
            _min(row[: row.size - window], row[window:], wider[: row.size - window])
            row, wider = wider, row
            window *= 2
        _min(row[:width], row[size - window : size - window + width], minima[radius + y])
    # A window of rows is the end of one block of rows and the beginning of the next.
    nearest, end, begin = np.empty_like(depth), np.empty((size, width), np.float32), np.empty(width, np.float32)
    for first in range(0, height, size):
        end[size - 1] = minima[first + size - 1]
        for i in range(size - 2, -1, -1):
            _min(end[i + 1], minima[first + i], end[i])
        begin[:] = np.float32(_MAX)
        for i in range(min(size, height - first)):
            _write(end[i], begin, depth[first + i], nearest[first + i])
            lower(minima[first + size + i], begin)
    return nearest
