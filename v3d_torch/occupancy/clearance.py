"""Distances between points and voxels."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor


class NearestVoxels:
    """Search of the nearest of many voxels, by a k-d tree of their centres.

    Args:
        centres: Centres of the voxels, metres, float64, shape :math:`(N, 3)`; N can be 0.
        max_distance: Distance up to which voxels are searched, metres.
    """

    def __init__(self, centres: Tensor, max_distance: float) -> None:
        self._centres = centres
        self._tree = cKDTree(centres.numpy())
        self._max_distance = max_distance

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Find the nearest voxel of each point.

        Args:
            points: Finite points, metres, float64, shape :math:`(P, 3)`.

        Returns:
            Centre of the nearest voxel, shape :math:`(P, 3)`, and whether there is one within the distance, bool, shape
            :math:`(P,)`; without one the centre is the point itself.
        """
        _, row = self._tree.query(points.numpy(), distance_upper_bound=self._max_distance)
        index = torch.from_numpy(np.asarray(row))
        near = index < len(self._centres)
        nearest = points.clone()
        nearest[near] = self._centres[index[near]]
        return nearest, near


def offsets_within(radius: float, size: float) -> Tensor:
    """Offsets from the voxel of a point to all voxels that a ball around the point can touch.

    Args:
        radius: Radius of the ball, metres.
        size: Side of a voxel, metres.

    Returns:
        Offsets, voxels, int64, shape :math:`(K, 3)`.
    """
    reach = math.ceil(radius / size)
    steps = torch.arange(-reach, reach + 1)
    offsets = torch.cartesian_prod(steps, steps, steps)
    nearest = (offsets.abs() - 1).clamp(min=0).to(torch.float64).norm(dim=1) * size
    return offsets[nearest <= radius]


def voxel_gap(points: Tensor, voxels: Tensor, size: float) -> Tensor:
    """Distance from points to cubes: 0 inside.

    Args:
        points: Points, metres, float64, shape :math:`(..., 3)`.
        voxels: Coordinates of voxels or blocks, int64, shape :math:`(..., 3)`.
        size: Side of a cube, metres.

    Returns:
        Distances, metres, float64.
    """
    low = voxels.to(torch.float64) * size
    return torch.maximum(low - points, points - (low + size)).clamp(min=0).norm(dim=-1)
