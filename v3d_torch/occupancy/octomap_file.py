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
from v3d_torch.kernels.voxel_blocks import BITS, UNKNOWN
from v3d_torch.occupancy.occupancy_map import OccupancyMap

_DEPTH = 16
"""Levels of an OctoMap tree below its root."""

_HALF = 1 << (_DEPTH - 1)
"""Key of the world's origin, voxels: the tree covers this many voxels in each direction."""

_FREE, _OCCUPIED, _INNER = 1, 2, 3
"""States of a child; 0 is unknown."""

Codes = NDArray[np.uint64]
States = NDArray[np.uint64]


def write_octomap(path: StrPath, occupancy: OccupancyMap) -> None:
    """Write a map as binary OctoMap file, in the world frame. Children of the same state are merged.

    Args:
        path: Path of the file.
        occupancy: Map.

    Raises:
        OutputError: If the file cannot be written, or the map is larger than OctoMap's trees.
    """
    path, tree, blocks = Path(path), _InnerNodes(), []
    for chunk in occupancy.blocks.chunks():
        known = chunk.log_odds != UNKNOWN
        voxels = chunk.voxels_where(known)
        if len(voxels) and int(torch.maximum(voxels, -voxels - 1).max()) >= _HALF:
            extent = _HALF * occupancy.config.voxel_size
            raise OutputError(
                f"{path}: the map is larger than an OctoMap of {extent:.0f} m in each direction; use larger voxels"
            )
        states = torch.where(chunk.log_odds[known] >= 0, _OCCUPIED, _FREE).numpy().astype(np.uint64)
        blocks.append(tree.add_leaves(_morton_codes(voxels.numpy()), states))
    codes, states = (np.concatenate(values) for values in zip(*blocks, strict=True))
    tree.add_parents(codes, states, range(BITS + 1, _DEPTH + 1))
    header = (
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id OcTree\nsize {tree.count}\nres {occupancy.config.voxel_size}\ndata\n"
    )
    with atomic_write(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + tree.words().astype("<u2").tobytes())


def _morton_codes(voxels: NDArray[np.int64]) -> Codes:
    """Interleave the bits of coordinates: x is the lowest bit of each three."""
    codes = np.zeros(len(voxels), np.uint64)
    keys = (voxels + _HALF).astype(np.uint64)
    for bit in range(_DEPTH):
        for axis in range(3):
            codes |= (keys[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return codes


class _InnerNodes:
    """Inner nodes of an octree, added from the leaves to the root.

    Attributes:
        count: Number of nodes so far, with leaves and without those that were merged.
    """

    def __init__(self) -> None:
        self.count = 0
        self._firsts: list[Codes] = []
        self._depths: list[NDArray[np.int64]] = []
        self._words: list[NDArray[np.uint64]] = []

    def add_leaves(self, codes: Codes, states: States) -> tuple[Codes, States]:
        """Add known voxels and the nodes up to the blocks of the map, which contain all voxels of these nodes.

        Args:
            codes: Morton codes of the voxels, (N,).
            states: State of each voxel, (N,).

        Returns:
            Codes and states of the blocks.
        """
        self.count += len(codes)
        return self.add_parents(codes, states, range(1, BITS + 1))

    def add_parents(self, codes: Codes, states: States, heights: range) -> tuple[Codes, States]:
        """Add the parents of nodes, the parents of these, and so on. Children of the same state are merged.

        Args:
            codes: Morton codes of the nodes, (N,).
            states: State of each node, (N,).
            heights: Heights of the parents above the voxels, ascending.

        Returns:
            Codes and states of the highest parents.
        """
        order = codes.argsort()
        codes, states = codes[order], states[order]
        for height in heights:
            parents, begin = np.unique(codes >> np.uint64(3), return_index=True)
            bits = states << (codes & np.uint64(7)) * np.uint64(2)
            word = np.bitwise_or.reduceat(bits, begin)
            merged = (word == 0x5555 * _FREE) | (word == 0x5555 * _OCCUPIED)
            self.count += len(parents) - 8 * int(merged.sum())
            self._firsts.append(parents[~merged] << np.uint64(3 * height))
            self._depths.append(np.full(len(parents) - int(merged.sum()), _DEPTH - height))
            self._words.append(word[~merged])
            codes, states = parents, np.where(merged, word & np.uint64(3), np.uint64(_INNER))
        return codes, states

    def words(self) -> NDArray[np.uint64]:
        """Words of the nodes in depth-first order: a node precedes its descendants, which precede the next child."""
        order = np.lexsort([np.concatenate(self._depths), np.concatenate(self._firsts)])
        return np.concatenate(self._words)[order]
