"""Voxel pooling: the mean point of each occupied voxel, for padded batches of point clouds (paper, Sec. III-B.2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_masks, check_positive, check_shape
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import voxel as kernels
from v3d_torch.kernels.compiler import can_read, compiled_by, to_array

_MAX_VOXELS = 2**62
"""Largest bounding box, in voxels: the voxels of larger boxes cannot be numbered with 64-bit integers."""


class Voxels(NamedTuple):
    """Occupied voxels of a batch of clouds, sorted by x, then y, then z, with padding at the end.

    Attributes:
        means: Mean of the points in each voxel, metres, shape :math:`(B, M, 3)`; 0 in the padding. Sums are
            in double precision, results in the dtype of the points, float32 for integers.
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
    is_mask = valid.dtype == torch.bool and points.shape[:2] == valid.shape
    if not is_cloud or not is_mask or not size > 0:
        return NotImplemented
    mask, coordinates = valid.numpy(), to_array(points)
    limits = np.float32(size), float(_MAX_VOXELS)
    pooled = [
        kernels.pool_voxels(cloud.compress(present, axis=0), *limits)
        for cloud, present in zip(coordinates, mask, strict=True)
    ]
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
        points: Points, metres, shape :math:`(B, N, 3)`.
        valid: Mask of the points that are not padding, bool, shape :math:`(B, N)`; the values of padding are ignored.
        size: Side of a voxel, metres.

    Returns:
        Occupied voxels; M is the largest number of voxels of a cloud in the batch. On devices other than the CPU, and
        if torch traces the computation, M is N, so that no shape depends on values. Differentiable in ``points``.

    Raises:
        ConfigError: If ``size`` is not positive.
        InputError: If a valid point is not finite, the points are too far apart to number the voxels between them, or
            ``valid`` is not bool.
    """
    check_masks(valid=valid)
    check_shape("points", points, "B", "N", 3)
    check_shape("valid", valid, *points.shape[:2])
    check_positive(size=size)
    voxel_index, occupied = _number_voxels(points.detach().to(working_dtype(points.dtype)), valid, size)
    batch, count = valid.shape
    voxels = count if not can_read(occupied) else int(occupied.max()) if batch else 0
    # Row 0 of each cloud collects its padding and is dropped. The axes are summed one by one, because torch would
    # spread the rows of a matrix over threads, which takes longer than the sum. Sums of many points in single precision
    # would lose digits.
    slot = voxel_index + 1
    axes = points.to(torch.float64).unbind(dim=2)
    sums = [axis.new_zeros(batch, voxels + 1).scatter_add(1, slot, axis) for axis in axes]
    counts = slot.new_zeros(batch, voxels + 1).scatter_add(1, slot, valid.to(torch.int64))[:, 1:]
    means = torch.stack(sums, dim=2)[:, 1:] / counts.clamp(min=1)[..., None]
    return Voxels(means.to(result_dtype(points.dtype)), counts > 0, counts, voxel_index)


def pool_cloud(points: Tensor, size: float) -> Voxels:
    """Pool one cloud without padding in single precision, for which there is a kernel; a batch of one.

    Args:
        points: Points, metres, shape :math:`(N, 3)`; their rounding is far smaller than a voxel.
        size: Side of a voxel, metres.
    """
    return voxel_pool(points[None].to(torch.float32), torch.ones(1, len(points), dtype=torch.bool), size)


def _number_voxels(points: Tensor, valid: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Number the occupied voxels of each cloud.

    Args:
        points: Points, shape (B, N, 3).
        valid: Mask of the points that are not padding, shape (B, N).
        size: Side of a voxel.

    Returns:
        Index of each point's voxel, from 0 in every cloud, -1 for padding, shape (B, N), and number of occupied voxels,
        shape (B,).
    """
    if valid.shape[1] == 0:
        return valid.to(torch.int64), valid.sum(dim=1)
    cells = (points / size).floor().to(torch.float64)
    low = torch.where(valid[..., None], cells, torch.inf).amin(dim=1, keepdim=True)
    sides = torch.where(valid[..., None], cells, -torch.inf).amax(dim=1, keepdim=True) - low + 1
    if can_read(valid) and not bool((sides.prod(dim=2) < _MAX_VOXELS)[valid.any(dim=1)].all()):  # also for NaN
        raise InputError(
            f"points are not finite or lie too far apart for voxels of {size} m; remove them or use larger voxels"
        )
    x, y, z = torch.where(valid[..., None], cells - low, 0.0).to(torch.int64).unbind(dim=2)
    _, y_side, z_side = torch.where(valid.any(dim=1)[:, None, None], sides, 0.0).to(torch.int64).unbind(dim=2)
    key = torch.where(valid, (x * y_side + y) * z_side + z, _MAX_VOXELS)  # number in the bounding box; padding is last
    key, order = key.sort(dim=1, stable=True)
    begins = torch.cat([torch.ones_like(valid[:, :1]), key[:, 1:] != key[:, :-1]], dim=1) & (key < _MAX_VOXELS)
    rank = torch.where(key < _MAX_VOXELS, begins.cumsum(dim=1) - 1, -1)
    return torch.zeros_like(order).scatter(1, order, rank), begins.sum(dim=1)


class VoxelPool(SettingsModule):
    """Voxel pooling as a module; see :func:`voxel_pool`.

    Args:
        size: Side of a voxel, metres.

    Raises:
        ConfigError: If a number is not possible; see :func:`voxel_pool`.
    """

    def __init__(self, size: float) -> None:
        check_positive(size=size)
        super().__init__()
        self.size = size

    def forward(self, points: Tensor, valid: Tensor) -> Voxels:
        """Pool clouds, metres, shape :math:`(B, N, 3)` with mask :math:`(B, N)`; see :func:`voxel_pool`."""
        return voxel_pool(points, valid, self.size)
