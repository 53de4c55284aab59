"""Kernel of the blocks of the occupancy map; see `v3d_torch.occupancy.voxel_blocks`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bytes, Ints, SignedBytes
from v3d_torch.kernels.compiler import device, kernel

BITS = 4
"""Binary logarithm of `SIDE`."""

SIDE = 1 << BITS
"""Voxels along a side of a block."""

VOLUME = SIDE**3
"""Voxels in a block."""

FREE, HIT = 1, 2
"""Observations of a voxel in one view; 0 if it was not observed."""

UNKNOWN = -128
"""Log-odds of voxels that were never observed, different from those of all other voxels."""


@device
def local_index(x: int, y: int, z: int) -> int:
    """Index of a voxel in its block, with z varying fastest."""
    return (((x & (SIDE - 1)) << BITS | (y & (SIDE - 1))) << BITS) | (z & (SIDE - 1))


@kernel("(i1[:,::1], i8[::1], u1[:,::1], i8, i8, i8, i8)")
def add_observations(
    log_odds: SignedBytes, rows: Ints, marks: Bytes, hit: int, miss: int, minimum: int, maximum: int
) -> None:
    """Add the observations of one view to the log-odds of blocks.

    Args:
        log_odds: Log-odds of all blocks, steps, (N, 4096); changed in place.
        rows: Row of each observed block, (B,).
        marks: Observations, (B, 4096).
        hit: Log-odds added to a voxel that was hit, steps.
        miss: Log-odds added to a voxel that was observed as free, steps.
        minimum: Smallest log-odds, steps.
        maximum: Largest log-odds, steps.
    """
    for i in range(len(rows)):
        block = log_odds[rows[i]]
        for voxel in range(VOLUME):
            mark = marks[i, voxel]
            if mark:
                before = 0 if block[voxel] == UNKNOWN else np.int64(block[voxel])
                after = before + (hit if mark == HIT else miss)
                block[voxel] = np.int8(min(max(after, minimum), maximum))
