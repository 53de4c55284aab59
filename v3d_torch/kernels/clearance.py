"""Kernel of free balls in the occupancy map; see `v3d_torch.occupancy.clearance`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats, Ints, SignedBytes
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.voxel_blocks import BITS, UNKNOWN, local_index


@device
def _find_block(x: int, y: int, z: int, keys: Ints, bound: int) -> int:
    """Place of the key of a block among ascending keys; -1 if it is not there."""
    if max(x, y, z) >= bound or min(x, y, z) < -bound:
        return -1
    key = ((x + bound) * 2 * bound + y + bound) * 2 * bound + z + bound
    place = int(np.searchsorted(keys, key))
    return place if place < len(keys) and keys[place] == key else -1


@device
def _squared_gap(point: float, voxel: int, size: float) -> float:
    """Squared distance along one axis between a coordinate and a voxel; 0 inside."""
    low = voxel * size
    gap = max(low - point, point - (low + size), 0.0)
    return gap * gap


@device
def _is_ball_free(
    point: Floats, radius: float, size: float, keys: Ints, rows: Ints, bound: int, log_odds: SignedBytes
) -> bool:
    """Check whether all voxels that a ball touches are free."""
    reach = math.ceil(radius / size)
    i, j, k = math.floor(point[0] / size), math.floor(point[1] / size), math.floor(point[2] / size)
    for x in range(i - reach, i + reach + 1):
        gap_x = _squared_gap(point[0], x, size)
        for y in range(j - reach, j + reach + 1):
            gap_y = _squared_gap(point[1], y, size)
            place, block_z = -1, 0
            for z in range(k - reach, k + reach + 1):
                if math.sqrt(gap_x + gap_y + _squared_gap(point[2], z, size)) > radius:
                    continue
                if place < 0 or z >> BITS != block_z:
                    block_z = z >> BITS
                    place = _find_block(x >> BITS, y >> BITS, block_z, keys, bound)
                if place < 0:
                    return False
                value = log_odds[rows[place], local_index(x, y, z)]
                if value >= 0 or value == UNKNOWN:
                    return False
    return True


@kernel("(f8[:,::1], f8, f8, i8[::1], i8[::1], i8, i1[:,::1])")
def are_balls_free(
    points: Floats, radius: float, size: float, keys: Ints, rows: Ints, bound: int, log_odds: SignedBytes
) -> Bools:
    """Check whether balls lie in free space.

    Args:
        points: Centres of the balls, metres, (P, 3).
        radius: Radius of the balls, metres.
        size: Side of a voxel, metres.
        keys: Keys of the blocks, ascending, (N,).
        rows: Row of each key's block, (N,).
        bound: Bound of the coordinates of blocks.
        log_odds: Log-odds of the blocks, steps, (N, 4096).

    Returns:
        True if all voxels that the ball touches are free, (P,).
    """
    free = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        free[i] = _is_ball_free(points[i], radius, size, keys, rows, bound, log_odds)
    return free
