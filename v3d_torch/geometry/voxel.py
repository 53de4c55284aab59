"""Voxel pooling: the mean point of every occupied voxel, on padded batches of clouds (paper, Sec. III-B.2)."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError


class Voxels(NamedTuple):
    """Occupied voxels of a batch of clouds, in order of their x, then y, then z cell; padded at the end.

    Attributes:
        means: mean of the points in each voxel, metres, shape :math:`(B, M, 3)`; 0 where padded.
        valid: which voxels exist, bool, shape :math:`(B, M)`.
        counts: points in each voxel, int64, shape :math:`(B, M)`; 0 where padded.
        owner: which voxel of its cloud each point is in, int64, shape :math:`(B, N)`; -1 for points that do not exist.
    """

    means: Tensor
    valid: Tensor
    counts: Tensor
    owner: Tensor


def voxel_pool(points: Tensor, valid: Tensor, size: float) -> Voxels:
    """Replace the points of every voxel by their mean.

    Voxel (i, j, k) holds the points with ``floor(point / size) == (i, j, k)``: the grid stands still while clouds move
    through it.

    Args:
        points: metres, float32 or float64, shape :math:`(B, N, 3)`.
        valid: which points exist, bool, shape :math:`(B, N)`; what stands in the others is not looked at.
        size: side of a voxel, metres.

    Returns:
        Occupied voxels, M being the most that any cloud of the batch has. Differentiable in ``points``.

    Raises:
        ConfigError: if ``size`` is not positive.
        InputError: if a valid point is not finite or too far off for its voxel to be numbered.
    """
    KORNIA_CHECK_SHAPE(points, ["B", "N", "3"])
    KORNIA_CHECK_SHAPE(valid, [str(size) for size in points.shape[:2]])
    if size <= 0:
        raise ConfigError(f"The side of a voxel must be positive, not {size} m.")
    mask = valid.numpy()
    owner = np.full(mask.shape, -1)
    present = np.flatnonzero(mask)
    if len(present) == 0:
        none = torch.zeros(len(valid), 0, dtype=torch.int64)
        return Voxels(points[:, :0], valid[:, :0], none, torch.from_numpy(owner))
    rows = points.reshape(-1, 3)
    keys = _keys(rows.detach().numpy().take(present, axis=0), size)
    owner.ravel()[present], counts = _group(keys, mask.sum(axis=1))

    # What stands where there is no point is added up as well, in front of the voxels of its cloud, and left out. One
    # axis at a time: torch shares out the rows of a matrix to threads, which takes longer than to add them.
    batch, most = counts.shape
    place = torch.from_numpy((owner + 1 + (most + 1) * np.arange(batch)[:, None]).ravel())
    sums = [axis.new_zeros(batch * (most + 1)).index_add(0, place, axis) for axis in rows.unbind(dim=1)]
    divisor = torch.from_numpy(counts).clamp(min=1)[..., None]
    means = torch.stack(sums, dim=1).reshape(batch, most + 1, 3)[:, 1:] / divisor
    return Voxels(means, *map(torch.from_numpy, (counts > 0, counts, owner)))


def _keys(points: NDArray[np.floating], size: float) -> NDArray[np.unsignedinteger]:
    """Number of each point's voxel in the box around all points, (N, 3) to (N,), counted along z, then y, then x."""
    cells = np.divide(points.T, size, order="C")
    np.floor(cells, out=cells)
    low, high = cells.min(axis=1), cells.max(axis=1)
    sides = [last - first + 1 for first, last in zip(low.tolist(), high.tolist(), strict=True)]
    box = sides[0] * sides[1] * sides[2]
    if not box < 2**62:  # nor is it where a side is not finite
        raise InputError(f"Points to be pooled are not finite or lie too far apart for voxels of {size} m.")
    # No more bytes than the box asks for, as the sort looks at each; but whole digits of 16 bits.
    dtype = np.promote_types(np.uint16, np.min_scalar_type(int(box)))
    key, y, z = (cells - low[:, None]).astype(dtype)
    for axis, side in ((y, sides[1]), (z, sides[2])):
        key *= int(side)
        key += axis
    return key


def _group(keys: NDArray[np.unsignedinteger], sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number the voxels of every cloud.

    Args:
        keys: of the points, cloud after cloud, shape (N,).
        sizes: points of each cloud, shape (B,).

    Returns:
        The voxel of each point, counted from 0 in every cloud, and the points in each voxel, shape (B, M).
    """
    ends = np.concatenate([[0], sizes.cumsum()])
    # NumPy sorts 16-bit integers by radix, in a tenth of the time that comparing keys takes.
    digits = keys.view(np.uint16).reshape(len(keys), -1).T
    order = np.concatenate([first + np.lexsort(digits[:, first:last]) for first, last in pairwise(ends.tolist())])
    keys = keys[order]

    begins = np.ones(len(keys) + 1, dtype=np.bool_)
    np.not_equal(keys[1:], keys[:-1], out=begins[1:-1])
    begins[ends] = True
    edges = np.flatnonzero(begins)  # voxel k, of all clouds, has the points from edges[k] to edges[k + 1]
    rank = edges.searchsorted(ends)
    first, last = rank[:-1, None], rank[1:, None]
    edges = edges.take(np.minimum(first + np.arange((last - first).max() + 1), last))
    counts = edges[:, 1:] - edges[:, :-1]

    voxel = np.empty_like(order)
    voxel[order] = np.tile(np.arange(counts.shape[1]), len(counts)).repeat(counts.ravel())
    return voxel, counts


class VoxelPool(torch.nn.Module):
    """:func:`voxel_pool` as a module.

    Args:
        size: side of a voxel, metres.
    """

    def __init__(self, size: float) -> None:
        super().__init__()
        self.size = size

    def forward(self, points: Tensor, valid: Tensor) -> Voxels:
        """Pool clouds, metres, shape :math:`(B, N, 3)` with mask :math:`(B, N)`; see :func:`voxel_pool`."""
        return voxel_pool(points, valid, self.size)
