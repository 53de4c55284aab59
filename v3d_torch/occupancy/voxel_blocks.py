"""Sparse voxel grid: log-odds of occupancy in blocks of 16 x 16 x 16 voxels, found by the keys of their coordinates.

Niessner et al., "Real-time 3D Reconstruction at Scale using Voxel Hashing", 2013. Keys are sorted instead of hashed, so
that one tensor operation looks up many voxels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from v3d_torch.geometry.cell_keys import MAX_COORDINATE, cell_keys
from v3d_torch.kernels import voxel_blocks as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.kernels.voxel_blocks import BITS, HIT, SIDE, UNKNOWN, VOLUME
from v3d_torch.occupancy.ray_casting import Observations, index_in_block
from v3d_torch.occupancy.sensor_model import SensorModel

_CHUNK_BLOCKS = 256
"""Maximum number of blocks of a chunk: a million voxels, whose coordinates need 100 MB with intermediate results."""


class VoxelBlocks:
    """Blocks of voxels with log-odds of occupancy.

    Attributes:
        coordinates: Coordinates of the blocks, int64, shape :math:`(N, 3)`.
        keys: Keys of the coordinates, ascending, int64, shape :math:`(N,)`.
        rows: Row of each key's block, int64, shape :math:`(N,)`.
    """

    def __init__(self) -> None:
        self.coordinates = torch.zeros(0, 3, dtype=torch.int64)
        self._log_odds = torch.zeros(0, VOLUME, dtype=torch.int8)  # with spare rows at the end
        self._sort_keys()

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.coordinates)

    @property
    def log_odds(self) -> Tensor:
        """View of the log-odds of the voxels, steps, int8, shape :math:`(N, 4096)` in the order x, y, z.

        They are `UNKNOWN` for voxels that were never observed.
        """
        return self._log_odds[: len(self)]

    def add(self, observations: Observations, model: SensorModel) -> None:
        """Add the observations of one view to the log-odds.

        Args:
            observations: Voxels that the view observes.
            model: Log-odds of hits and misses.
        """
        rows = self.find(observations.blocks)
        if bool((missing := rows < 0).any()):
            self._append(observations.blocks[missing])
            rows = self.find(observations.blocks)
        add_observations(self._log_odds, rows, observations.marks, model)

    def find(self, blocks: Tensor) -> Tensor:
        """Find the rows of blocks.

        Args:
            blocks: Coordinates of blocks, int64, shape :math:`(M, 3)`.

        Returns:
            Rows, int64, shape :math:`(M,)`; -1 for blocks that do not exist.
        """
        if len(self) == 0:
            return blocks.new_full(blocks.shape[:1], -1)
        keys = cell_keys(blocks)
        place = torch.searchsorted(self.keys, keys).clamp(max=len(self) - 1)
        in_range = ((blocks >= -MAX_COORDINATE) & (blocks < MAX_COORDINATE)).all(dim=1)
        return torch.where(in_range & (self.keys[place] == keys), self.rows[place], -1)

    def log_odds_at(self, voxels: Tensor) -> Tensor:
        """Log-odds of voxels.

        Args:
            voxels: Coordinates of voxels, int64, shape :math:`(M, 3)`.

        Returns:
            Log-odds, steps, int8, shape :math:`(M,)`; `UNKNOWN` for voxels that were never observed.
        """
        if len(self) == 0:
            return torch.full((len(voxels),), UNKNOWN, dtype=torch.int8)
        rows = self.find(voxels >> BITS)
        found = self.log_odds.flatten()[rows.clamp(min=0) * VOLUME + index_in_block(voxels)]
        return torch.where(rows >= 0, found, UNKNOWN)

    def keep(self, mask: Tensor) -> None:
        """Remove all blocks except those in a bool mask; the others keep their order."""
        self.load_state_dict({"coordinates": self.coordinates[mask], "log_odds": self.log_odds[mask]})

    def count_known(self) -> Tensor:
        """Number of voxels of each block that were observed, int64, shape :math:`(N,)`."""
        return torch.cat([(chunk.log_odds != UNKNOWN).sum(dim=1) for chunk in self.chunks()])

    def copy_better_observed(self, other: VoxelBlocks) -> None:
        """Copy blocks of another grid: those that this grid lacks, and those with twice as many observed voxels."""
        missing = self.find(other.coordinates) < 0
        if bool(missing.any()):
            self._append(other.coordinates[missing])
        rows = self.find(other.coordinates)
        better = other.count_known() >= 2 * self.count_known()[rows]
        self._log_odds[rows[better]] = other.log_odds[better]

    def chunks(self) -> Iterator[VoxelBlocks]:
        """Yield chunks with some of the blocks each, in their order, so that work on all voxels needs little memory.

        There is at least one chunk. Chunks share the memory of the blocks and are only read.
        """
        for first in range(0, max(len(self), 1), _CHUNK_BLOCKS):
            rows, chunk = slice(first, first + _CHUNK_BLOCKS), VoxelBlocks()
            chunk.load_state_dict({"coordinates": self.coordinates[rows], "log_odds": self.log_odds[rows]})
            yield chunk

    def voxels_where(self, mask: Tensor) -> Tensor:
        """Coordinates of voxels.

        Args:
            mask: Selected voxels, bool, shape :math:`(N, 4096)`.

        Returns:
            Coordinates, int64, shape :math:`(M, 3)`.
        """
        row, index = torch.nonzero(mask).unbind(dim=1)
        local = torch.stack([index >> 2 * BITS, (index >> BITS) & (SIDE - 1), index & (SIDE - 1)], dim=1)
        return (self.coordinates[row] << BITS) + local

    def state_dict(self) -> dict[str, Any]:
        """Return the blocks."""
        return {"coordinates": self.coordinates, "log_odds": self.log_odds.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Replace the blocks by those of `state_dict`."""
        self.coordinates, self._log_odds = state["coordinates"], state["log_odds"]
        self._sort_keys()

    def _append(self, blocks: Tensor) -> None:
        """Append unknown blocks."""
        end = len(self) + len(blocks)
        if end > len(self._log_odds):
            grown = torch.full((max(end, 2 * len(self._log_odds)), VOLUME), UNKNOWN, dtype=torch.int8)
            grown[: len(self)] = self.log_odds
            self._log_odds = grown
        self.coordinates = torch.cat([self.coordinates, blocks])
        self._sort_keys()

    def _sort_keys(self) -> None:
        self.keys, self.rows = cell_keys(self.coordinates).sort()


def _add_compiled(log_odds: Tensor, rows: Tensor, marks: Tensor, model: SensorModel) -> None:
    limits = model.hit, model.miss, model.minimum, model.maximum
    kernels.add_observations(log_odds.numpy(), rows.numpy(), marks.numpy(), *limits)


@compiled_by(_add_compiled)
def add_observations(log_odds: Tensor, rows: Tensor, marks: Tensor, model: SensorModel) -> None:
    r"""Add the log-odds of hits and misses in place: :math:`L \leftarrow \min(\max(L + l, l_{min}), l_{max})`.

    Args:
        log_odds: Log-odds of all blocks, steps, int8, shape :math:`(N, 4096)`; changed in place.
        rows: Row of each observed block, int64, shape :math:`(B,)`; no two are equal.
        marks: Observations, see `Observations`, uint8, shape :math:`(B, 4096)`.
        model: Log-odds of hits and misses.
    """
    before = log_odds[rows].to(torch.int64)
    change = torch.where(marks == HIT, model.hit, model.miss)
    after = (torch.where(before == UNKNOWN, 0, before) + change).clamp(model.minimum, model.maximum)
    log_odds[rows] = torch.where(marks > 0, after, before).to(torch.int8)
