"""Kernel of the depth smoother; see `v3d_torch.geometry.depth_smoother`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats32
from v3d_torch.kernels.compiler import device, kernel


@device
def _accumulate(
    z: Floats32, max_difference: Floats32, z_neighbour: Floats32, total: Floats32, weight: Floats32, tap: np.float32,
    sums: Floats32, weights: Floats32,
) -> None:  # fmt: skip
    """Add the weighted depth differences of one neighbour of each pixel of a row; all arrays have shape (W,).

    The compiler vectorises only loops over few arrays, so there is one loop for each result.
    """
    for x in range(len(z)):
        step = z_neighbour[x] - z[x]
        gate = tap if abs(step) <= max_difference[x] else np.float32(0)
        sums[x] += gate * (total[x] + weight[x] * step)
    for x in range(len(z)):
        step = z_neighbour[x] - z[x]
        gate = tap if abs(step) <= max_difference[x] else np.float32(0)
        weights[x] += gate * weight[x]


@kernel("(f4[:,::1], f4[::1], f4, f4, f4[:,::1])")
def smooth_depth(
    depth: Floats32, taps: Floats32, edge_ratio: np.float32, max_depth: np.float32, smoothed: Floats32
) -> None:
    """Smooth a depth image in one sweep: rows first, then columns as soon as all rows of a window are summed.

    Args:
        depth: Depth, metres, (H, W); 0 = no measurement.
        taps: Weights of the Gaussian from the centre outwards, (R + 1,).
        edge_ratio: Largest accepted difference from the centre's depth, as a fraction of the centre's depth.
        max_depth: Depth above this counts as missing, metres.
        smoothed: Smoothed depth, metres, (H, W), written; 0 for pixels without measurement.
    """
    height, width = depth.shape
    radius, size = len(taps) - 1, 2 * len(taps) - 1
    missing, zero = np.float32(-2) * max_depth, np.float32(0)
    # Ring buffers of the rows in the window; the margins at both sides of the depth are missing pixels.
    z = np.full((size, width + 2 * radius), missing, np.float32)
    max_difference = np.empty((size, width), np.float32)
    totals, weights = np.empty((size, width), np.float32), np.empty((size, width), np.float32)
    zeros, ones = np.zeros(width, np.float32), np.ones(width, np.float32)
    total, weight = np.empty(width, np.float32), np.empty(width, np.float32)
    inside = slice(radius, radius + width)
    for row in range(height + radius):
        if row < height:
            k = row % size
            centre, source, gate = z[k, inside], depth[row], max_difference[k]
            for x in range(width):
                measured = (source[x] > 0) & (source[x] < max_depth)
                centre[x] = source[x] if measured else missing
            for x in range(width):
                limit = edge_ratio * centre[x]
                limit = limit if limit > 0 else zero
                gate[x] = limit if limit < max_depth else max_depth
            totals[k], weights[k] = zero, taps[0]
            for distance in range(1, radius + 1):
                for shift in (distance, -distance):
                    beside = z[k, radius + shift : radius + shift + width]
                    _accumulate(centre, gate, beside, zeros, ones, taps[distance], totals[k], weights[k])
        middle = row - radius
        if middle < 0:
            continue
        k = middle % size
        centre, result = z[k, inside], smoothed[middle]
        row_total, row_weight = totals[k], weights[k]
        for x in range(width):
            total[x] = taps[0] * row_total[x]
        for x in range(width):
            weight[x] = taps[0] * row_weight[x]
        for distance in range(1, radius + 1):
            for other in (middle + distance, middle - distance):
                if 0 <= other < height:
                    j = other % size
                    _accumulate(
                        centre, max_difference[k], z[j, inside], totals[j], weights[j], taps[distance], total, weight
                    )
        for x in range(width):
            mean = centre[x] + total[x] / weight[x]
            result[x] = mean if centre[x] > 0 else zero
