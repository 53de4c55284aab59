"""Voxel pooling: the mean point of every occupied voxel, on padded batches of clouds (paper, Sec. III-B.2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError


class Voxels(NamedTuple):
    """Occupied voxels of a batch of clouds, in order of their x, then y, then z cell; padded at the end.

    Attributes:
        means: mean of the points in each voxel, metres, shape :math:`(B, M, 3)`; 0 where padded.
        valid: which voxels exist, bool, shape :math:`(B, M)`.
        counts: points in each voxel, int64, shape :math:`(B, M)`; 0 where padded.
    """

    means: Tensor
    valid: Tensor
    counts: Tensor


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
    batch = valid.shape[0]
    cloud = valid.nonzero()[:, 0]
    present = points[valid]

    key = _voxel_keys(present.detach(), cloud, batch, size)
    # NumPy sorts some 10^4 keys in a third of torch's time.
    _, *voxels = np.unique(key.numpy(), return_inverse=True, return_counts=True)
    voxel, counts = map(torch.from_numpy, voxels)
    sums = present.new_zeros(len(counts), 3).index_add(0, voxel, present)
    means = sums / counts[:, None]

    # Voxels come sorted by cloud: the place of each in its cloud's row is its distance to the cloud's first.
    cloud_of_voxel = torch.empty_like(counts).scatter_(0, voxel, cloud)
    per_cloud = cloud_of_voxel.bincount(minlength=batch)
    place = torch.arange(len(counts)) - (per_cloud.cumsum(0) - per_cloud)[cloud_of_voxel]
    row = (cloud_of_voxel, place)
    shape = (batch, int(per_cloud.max()) if batch else 0)
    return Voxels(
        means=means.new_zeros(*shape, 3).index_put(row, means),
        valid=torch.zeros(shape, dtype=torch.bool).index_put(row, torch.tensor(True)),
        counts=counts.new_zeros(shape).index_put(row, counts),
    )


def _voxel_keys(points: Tensor, cloud: Tensor, batch: int, size: float) -> Tensor:
    """One integer per point, equal for points of the same cloud and voxel and sorted by cloud, x, y, z."""
    if len(points) == 0:
        return cloud
    cells = (points / size).floor().T.contiguous()
    low = cells.amin(dim=1, keepdim=True)
    extent = (cells.amax(dim=1) - low[:, 0] + 1).tolist()
    # Not finite makes the comparison false as well.
    if not batch * extent[0] * extent[1] * extent[2] < 2**62:
        raise InputError(f"Points to be pooled are not finite or lie too far apart for voxels of {size} m.")
    x, y, z = (cells - low).to(torch.int64)
    _, extent_y, extent_z = (int(along) for along in extent)
    return ((cloud * int(extent[0]) + x) * extent_y + y) * extent_z + z


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
