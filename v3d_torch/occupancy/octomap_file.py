"""Occupancy maps as binary files of OctoMap (``.bt``): free, occupied and unknown space in an octree.

Hornung et al., "OctoMap: An Efficient Probabilistic 3D Mapping Framework Based on Octrees", Autonomous Robots 2013,
Sec. 3.6. The nodes are written in the order of a depth-first traversal, two bytes for each inner node: two bits for
each of its children.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.errors import OutputError
from v3d_torch.io.files import atomic_write
from v3d_torch.io.paths import StrPath
from v3d_torch.kernels.voxel_blocks import UNKNOWN
from v3d_torch.occupancy.occupancy_map import OccupancyMap

_DEPTH = 16
"""Levels of an OctoMap tree below its root."""

_HALF = 1 << (_DEPTH - 1)
"""Key of the world's origin, voxels: the tree covers this many voxels in each direction."""

_FREE, _OCCUPIED, _INNER = 1, 2, 3
"""States of a child; 0 is unknown."""

Codes = NDArray[np.uint64]
Levels = list[tuple[Codes, NDArray[np.uint64]]]


def write_octomap(path: StrPath, occupancy: OccupancyMap) -> None:
    """Write a map as binary OctoMap file, in the world frame. Children of the same state are merged.

    Args:
        path: Path of the file.
        occupancy: Map.

    Raises:
        OutputError: If the file cannot be written, or the map is larger than OctoMap's trees.
    """
    path, log_odds = Path(path), occupancy.blocks.log_odds
    known = log_odds != UNKNOWN
    voxels = occupancy.blocks.voxels_where(known)
    states = torch.where(log_odds[known] >= 0, _OCCUPIED, _FREE).numpy().astype(np.uint64)
    if len(voxels) and int(torch.maximum(voxels, -voxels - 1).max()) >= _HALF:
        extent = _HALF * occupancy.config.voxel_size
        raise OutputError(
            f"{path}: the map is larger than an OctoMap of {extent:.0f} m in each direction; use larger voxels"
        )
    words, count = _encode(_morton_codes(voxels.numpy()), states)
    header = (
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id OcTree\nsize {count}\nres {occupancy.config.voxel_size:g}\ndata\n"
    )
    with atomic_write(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + words.astype("<u2").tobytes())


def _morton_codes(voxels: NDArray[np.int64]) -> Codes:
    """Interleave the bits of coordinates: x is the lowest bit of each three."""
    codes = np.zeros(len(voxels), np.uint64)
    keys = (voxels + _HALF).astype(np.uint64)
    for bit in range(_DEPTH):
        for axis in range(3):
            codes |= (keys[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return codes


def _encode(codes: Codes, states: NDArray[np.uint64]) -> tuple[NDArray[np.uint64], int]:
    """Encode an octree from its known leaves.

    Args:
        codes: Morton codes of the leaves, (N,).
        states: State of each leaf, (N,).

    Returns:
        Word of each inner node in the order of the file, and the number of nodes.
    """
    order = codes.argsort()
    codes, states = codes[order], states[order]
    firsts, depths, words, count = [], [], [], len(codes)
    for height in range(1, _DEPTH + 1):  # from the leaves to the root
        parents, begin = np.unique(codes >> np.uint64(3), return_index=True)
        bits = states << (codes & np.uint64(7)) * np.uint64(2)
        word = np.bitwise_or.reduceat(bits, begin) if len(codes) else bits
        merged = (word == 0x5555 * _FREE) | (word == 0x5555 * _OCCUPIED)
        count += len(parents) - 8 * int(merged.sum())
        firsts.append(parents[~merged] << np.uint64(3 * height))
        depths.append(np.full(len(parents) - int(merged.sum()), _DEPTH - height))
        words.append(word[~merged])
        codes, states = parents, np.where(merged, word & np.uint64(3), np.uint64(_INNER))
    # Depth-first order: a node precedes its descendants, which precede the next child.
    order = np.lexsort([np.concatenate(depths), np.concatenate(firsts)])
    return np.concatenate(words)[order], count
