"""Voxel pooling: the mean point of each occupied voxel, for padded batches of point clouds (paper, Sec. III-B.2)."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.kernels import voxel as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

_MAX_VOXELS = 2**62
"""Largest bounding box, in voxels: the voxels of larger boxes cannot be numbered with 64-bit integers."""


class Voxels(NamedTuple):
    """Occupied voxels of a batch of clouds, sorted by x, then y, then z, with padding at the end.

    Attributes:
        means: Mean of the points in each voxel, metres, shape :math:`(B, M, 3)`; 0 in the padding.
        valid: Mask of the voxels that are not padding, bool, shape :math:`(B, M)`.
        counts: Number of points in each voxel, int64, shape :math:`(B, M)`; 0 in the padding.
        voxel_index: Index of each point's voxel within its cloud, int64, shape :math:`(B, N)`; -1 for invalid points.
    """

    means: Tensor
    valid: Tensor
    counts: Tensor
    voxel_index: Tensor


def _voxel_pool_compiled(points: Tensor, valid: Tensor, size: float) -> Voxels:
    is_cloud = points.dtype == torch.float32 and points.ndim == 3 and points.shape[2] == 3
    if not is_cloud or points.shape[:2] != valid.shape or size <= 0:
        return NotImplemented
    mask, coordinates = valid.numpy(), to_array(points)
    limits = np.float32(size), float(_MAX_VOXELS)
    pooled = [kernels.pool_voxels(cloud[present], *limits) for cloud, present in zip(coordinates, mask, strict=True)]
    if any(len(index) > 0 and len(means) == 0 for means, _, index in pooled):
        return NotImplemented
    shape = len(pooled), max((len(means) for means, _, _ in pooled), default=0)
    means, counts, voxel_index = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.int64), np.full(mask.shape, -1)
    for i, (cloud_means, cloud_counts, index) in enumerate(pooled):
        means[i, : len(cloud_means)], counts[i, : len(cloud_means)] = cloud_means, cloud_counts
        voxel_index[i, mask[i]] = index
    return Voxels(*map(torch.from_numpy, (means, counts > 0, counts, voxel_index)))


@compiled_by(_voxel_pool_compiled)
def voxel_pool(points: Tensor, valid: Tensor, size: float) -> Voxels:
    """Replace the points of each voxel by their mean.

    Voxel (i, j, k) contains the points with ``floor(point / size) == (i, j, k)``: the grid is fixed to the origin and
    does not depend on the cloud.

    Args:
        points: Points, metres, float32 or float64, shape :math:`(B, N, 3)`.
        valid: Mask of the points that are not padding, bool, shape :math:`(B, N)`; the values of padding are ignored.
        size: Side of a voxel, metres.

    Returns:
        Occupied voxels; M is the largest number of voxels of a cloud in the batch. Differentiable in ``points``.

    Raises:
        ConfigError: If ``size`` is not positive.
        InputError: If a valid point is not finite, or the points are too far apart to number the voxels between them.
    """
    KORNIA_CHECK_SHAPE(points, ["B", "N", "3"])
    KORNIA_CHECK_SHAPE(valid, [str(length) for length in points.shape[:2]])
    if size <= 0:
        raise ConfigError(f"the voxel size is {size} m; give a positive number")
    mask = valid.numpy()
    voxel_index = np.full(mask.shape, -1)
    present = np.flatnonzero(mask)
    if len(present) == 0:
        none = torch.zeros(len(valid), 0, dtype=torch.int64)
        return Voxels(points[:, :0], valid[:, :0], none, torch.from_numpy(voxel_index))
    rows = points.reshape(-1, 3)
    keys = _keys(rows.detach().numpy().take(present, axis=0), size)
    voxel_index.ravel()[present], counts = _group(keys, mask.sum(axis=1))

    # Row 0 of each cloud collects its padding and is dropped. The axes are summed one by one, because torch would
    # spread the rows of a matrix over threads, which takes longer than the sum.
    batch, voxels = counts.shape
    slot = torch.from_numpy((voxel_index + 1 + (voxels + 1) * np.arange(batch)[:, None]).ravel())
    sums = [axis.new_zeros(batch * (voxels + 1)).index_add(0, slot, axis) for axis in rows.unbind(dim=1)]
    divisor = torch.from_numpy(counts).clamp(min=1)[..., None]
    means = torch.stack(sums, dim=1).reshape(batch, voxels + 1, 3)[:, 1:] / divisor
    return Voxels(means, *map(torch.from_numpy, (counts > 0, counts, voxel_index)))


def _keys(points: NDArray[np.floating], size: float) -> NDArray[np.unsignedinteger]:
    """Voxel number of each point in the bounding box of all points, (N, 3) to (N,), with z varying fastest."""
    cells = np.divide(points.T, size, order="C")
    np.floor(cells, out=cells)
    low, high = cells.min(axis=1), cells.max(axis=1)
    sides = [last - first + 1 for first, last in zip(low.tolist(), high.tolist(), strict=True)]
    box = sides[0] * sides[1] * sides[2]
    if not box < _MAX_VOXELS:  # also true if a side is NaN or infinite
        raise InputError(
            f"points are not finite or lie too far apart for voxels of {size} m; remove them or use larger voxels"
        )
    # The sort takes time for every byte, so the keys use the smallest integer type that is a multiple of 16 bits.
    dtype = np.promote_types(np.uint16, np.min_scalar_type(int(box)))
    key, y, z = (cells - low[:, None]).astype(dtype)
    for axis, side in ((y, sides[1]), (z, sides[2])):
        key *= int(side)
        key += axis
    return key


def _group(keys: NDArray[np.unsignedinteger], sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number the occupied voxels of each cloud.

    Args:
        keys: Voxel numbers of the points, cloud after cloud, shape (N,).
        sizes: Number of points of each cloud, shape (B,).

    Returns:
        Index of each point's voxel, from 0 in every cloud, shape (N,), and number of points per voxel, shape (B, M).
    """
    ends = np.concatenate([[0], sizes.cumsum()])
    # Sort by 16-bit digits: NumPy sorts 16-bit integers by radix, which is faster than comparing whole keys.
    digits = keys.view(np.uint16).reshape(len(keys), -1).T
    order = np.concatenate([first + np.lexsort(digits[:, first:last]) for first, last in pairwise(ends.tolist())])
    keys = keys[order]

    begins = np.ones(len(keys) + 1, dtype=np.bool_)
    np.not_equal(keys[1:], keys[:-1], out=begins[1:-1])
    begins[ends] = True
    edges = np.flatnonzero(begins)  # voxel k of all clouds has the sorted points edges[k] to edges[k + 1]
    rank = edges.searchsorted(ends)
    first, last = rank[:-1, None], rank[1:, None]
    edges = edges.take(np.minimum(first + np.arange((last - first).max() + 1), last))
    counts = edges[:, 1:] - edges[:, :-1]

    voxel = np.empty_like(order)
    voxel[order] = np.tile(np.arange(counts.shape[1]), len(counts)).repeat(counts.ravel())
    return voxel, counts


class VoxelPool(torch.nn.Module):
    """Voxel pooling as a module; see :func:`voxel_pool`.

    Args:
        size: Side of a voxel, metres.
    """

    def __init__(self, size: float) -> None:
        super().__init__()
        self.size = size

    def forward(self, points: Tensor, valid: Tensor) -> Voxels:
        """Pool clouds, metres, shape :math:`(B, N, 3)` with mask :math:`(B, N)`; see :func:`voxel_pool`."""
        return voxel_pool(points, valid, self.size)
