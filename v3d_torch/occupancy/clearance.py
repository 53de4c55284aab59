"""Clearance of points: the nearest occupied voxel, and balls in free space."""

from __future__ import annotations

import math

import numpy as np
import scipy
import torch
from torch import Tensor

from v3d_torch.geometry.cell_keys import MAX_COORDINATE
from v3d_torch.kernels import clearance as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.kernels.voxel_blocks import UNKNOWN
from v3d_torch.occupancy.voxel_blocks import VoxelBlocks

_BATCH = 1 << 20
"""Number of voxels that are looked up at once; it bounds the memory."""


class NearestVoxels:
    """Search of the nearest of many voxels, by a k-d tree of their centres.

    Args:
        centres: Centres of the voxels, metres, float64, shape :math:`(N, 3)`; N can be 0.
        max_distance: Maximum distance of a voxel that is found, metres.
    """

    def __init__(self, centres: Tensor, max_distance: float) -> None:
        self._centres = centres
        self._tree = scipy.spatial.cKDTree(centres.numpy())
        self._max_distance = max_distance

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Find the nearest voxel of each point.

        Args:
            points: Points, metres, float64, shape :math:`(P, 3)`.

        Returns:
            Centre of the nearest voxel, shape :math:`(P, 3)`, and mask of the points with a voxel within the distance,
            bool, shape :math:`(P,)`; for other points, and for those that are not finite, the centre is the point
            itself.
        """
        is_finite = points.isfinite().all(dim=1)  # SciPy rejects other points
        finite = points.where(is_finite[:, None], 0.0)
        _, row = self._tree.query(finite.numpy(), distance_upper_bound=self._max_distance)
        index = torch.from_numpy(np.asarray(row))
        near = is_finite & (index < len(self._centres))
        nearest = points.clone()
        nearest[near] = self._centres[index[near]]
        return nearest, near


def _compiled(blocks: VoxelBlocks, points: Tensor, radius: float, size: float) -> Tensor:
    if points.dtype != torch.float64:
        return NotImplemented
    index = blocks.keys.numpy(), blocks.rows.numpy(), MAX_COORDINATE, blocks.log_odds.numpy()
    return torch.from_numpy(kernels.are_balls_free(to_array(points), radius, size, *index))


@compiled_by(_compiled)
def are_balls_free(blocks: VoxelBlocks, points: Tensor, radius: float, size: float) -> Tensor:
    """Check whether every voxel that a ball touches is free.

    Args:
        blocks: Voxels.
        points: Finite centres of the balls, metres, float64, shape :math:`(P, 3)`.
        radius: Radius of the balls, metres.
        size: Side of a voxel, metres.

    Returns:
        Bool, shape :math:`(P,)`.
    """
    reach = math.ceil(radius / size)
    steps = torch.arange(-reach, reach + 1)
    offsets = torch.cartesian_prod(steps, steps, steps)
    free = torch.ones(len(points), dtype=torch.bool)
    for rows in torch.arange(len(points)).split(max(_BATCH // len(offsets), 1)):
        voxels = (points[rows] / size).floor().to(torch.int64)[:, None] + offsets
        touched = cube_gap(points[rows, None], voxels, size) <= radius
        log_odds = blocks.log_odds_at(voxels[touched])
        blocked = torch.zeros_like(touched)
        blocked[touched] = (log_odds >= 0) | (log_odds == UNKNOWN)
        free[rows] = ~blocked.any(dim=1)
    return free


def cube_gap(points: Tensor, cubes: Tensor, size: float) -> Tensor:
    """Distance from points to cubes; 0 inside.

    Args:
        points: Points, metres, float64, shape :math:`(..., 3)`.
        cubes: Coordinates of voxels or blocks, int64, shape :math:`(..., 3)`.
        size: Side of a cube, metres.

    Returns:
        Distances, metres, float64.
    """
    low = cubes.to(torch.float64) * size
    x, y, z = torch.maximum(low - points, points - (low + size)).clamp(min=0).square().unbind(dim=-1)
    return (x + y + z).sqrt()
