"""Floor of an occupancy map: the lowest horizontal plane, by consensus of the normals and heights of its voxels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState
from v3d_torch.occupancy.up_direction import UpDirection

_MAX_VOXELS = 8192
"""Voxels that are used, which bounds the time; of more, every n-th is used."""

_MAX_CANDIDATES = 1024
"""Normals that are compared with all others as up direction; of more, every n-th is used."""

_NORMAL_RADIUS = 2
"""Voxels around a voxel whose states give its normal."""

_DIRECTION_TOLERANCE = math.radians(10)
"""Error of the normal of a single voxel, as the states around it are coarse."""

_FACING_TOLERANCE = math.radians(30)
"""Largest angle between up and the normal of a voxel of the floor; at the foot of a wall the normal is tilted."""

_MIN_VOXELS = 30
"""Smallest number of voxels that determine a direction or a plane."""

_MAX_LEVELS = 6
"""Levels of horizontal surfaces that are used: floor, tables, shelves."""

_MIN_AREA = 0.25
"""Smallest visible area of a floor, square metres; steps and boxes are smaller."""

_MAX_BELOW = 0.2
"""Largest number of voxels below the floor, as a fraction of its own: below a table there are more."""

_REFINEMENTS = 3
"""Times that direction and plane are fitted again to their voxels."""


@dataclass(frozen=True)
class Floor:
    """Floor plane ``up @ p = offset``.

    Attributes:
        up: Unit normal that points up, world frame, float64, shape :math:`(3,)`.
        offset: Distance of the plane from the world's origin along ``up``, metres.
        area: Visible area, square metres.
    """

    up: Tensor
    offset: float
    area: float

    def height(self, points: Tensor) -> Tensor:
        """Height of points above the floor, metres.

        Args:
            points: Points, world frame, metres, shape :math:`(..., 3)`.
        """
        return points.to(torch.float64) @ self.up - self.offset


def find_floor(occupancy: OccupancyMap, up: UpDirection) -> Floor | None:
    """Find the floor of a map.

    The up direction is the normal with which most other normals agree: those of floor, tables and ceiling are parallel.
    Then the levels at which most upward voxels lie are found, and parallel planes are fitted to all of them, because
    often only a small part of the floor is visible. The floor is the lowest level that is large enough and has few
    voxels below it. All voxels are hypotheses, so that nothing is random.

    Args:
        occupancy: Map.
        up: Approximate up direction.

    Returns:
        The floor; None if none is visible.
    """
    size, points = occupancy.config.voxel_size, occupancy.occupied_points
    step = max(math.ceil(len(points) / _MAX_VOXELS), 1)
    points = points[::step]
    normals = _voxel_normals(occupancy, points)
    direction = _common_direction(normals, up)
    if direction is None:
        return None
    points = points[normals @ direction > math.cos(_FACING_TOLERANCE)]
    for _ in range(_REFINEMENTS):
        direction = _fit_normal(points, _find_levels(points @ direction, size), size, direction)
    if direction @ up.direction < math.cos(up.tolerance):
        return None
    return _lowest_level(points @ direction, direction, size, step * size**2)


def _voxel_normals(occupancy: OccupancyMap, points: Tensor) -> Tensor:
    """Unit directions from occupied voxels, (N, 3), to the free space around them; 0 without free space."""
    steps = torch.arange(-_NORMAL_RADIUS, _NORMAL_RADIUS + 1) * occupancy.config.voxel_size
    offsets = torch.cartesian_prod(*3 * [steps.to(torch.float64)])
    free = occupancy.states(points[:, None] + offsets) == VoxelState.FREE
    return normalize(free.to(torch.float64) @ normalize(offsets, dim=1), dim=1)


def _common_direction(normals: Tensor, up: UpDirection) -> Tensor | None:
    """The direction near up with which most normals agree, up or down, (3,); None if too few do."""
    candidates = normals[normals @ up.direction > math.cos(up.tolerance)]
    candidates = candidates[:: max(math.ceil(len(candidates) / _MAX_CANDIDATES), 1)]
    agreeing = ((normals @ candidates.T).abs() > math.cos(_DIRECTION_TOLERANCE)).sum(dim=0)
    if len(candidates) == 0 or int(agreeing.max()) < _MIN_VOXELS:
        return None
    direction = candidates[int(agreeing.argmax())]
    for _ in range(_REFINEMENTS):
        cosine = normals @ direction
        near = cosine.abs() > math.cos(_DIRECTION_TOLERANCE)
        direction = normalize((normals * cosine.sign()[:, None])[near].sum(dim=0), dim=0)
    return direction


def _find_levels(heights: Tensor, size: float) -> list[Tensor]:
    """Masks of the points at each level, (N,) each, by number of points: a level is two voxels high."""
    free, levels = torch.ones_like(heights, dtype=torch.bool), []
    for _ in range(_MAX_LEVELS):
        own = heights[free].sort().values
        counts = _count_near(own, own, size)
        if len(own) == 0 or int(counts.max()) < _MIN_VOXELS:
            break
        level = free & ((heights - own[int(counts.argmax())]).abs() <= size)
        levels.append(level)
        free = free & ~level
    return levels


def _fit_normal(points: Tensor, levels: list[Tensor], size: float, direction: Tensor) -> Tensor:
    """Common normal of the planes through the points (N, 3) of each level."""
    scatter = size**2 * torch.eye(3, dtype=points.dtype)
    for level in levels:
        centred = points[level] - points[level].mean(dim=0)
        scatter = scatter + centred.T @ centred
    normal = torch.linalg.eigh(scatter).eigenvectors[:, 0]
    return normal * (normal @ direction).sign() if levels else direction


def _lowest_level(heights: Tensor, up: Tensor, size: float, area: float) -> Floor | None:
    """The lowest level of enough points with these heights (N,), of which each covers an area."""
    heights = heights.sort().values
    counts = _count_near(heights, heights, size)
    below = torch.searchsorted(heights, heights - size)
    is_floor = (counts >= _MIN_VOXELS) & (counts * area >= _MIN_AREA) & (below <= _MAX_BELOW * counts)
    if not bool(is_floor.any()):
        return None
    # The lowest voxels of a floor are noise; its height is that at which most of them lie.
    near = heights <= heights[is_floor][0] + 2 * size
    offset = heights[int(torch.where(near, counts, 0).argmax())]
    offset = heights[(heights - offset).abs() <= size].mean()
    return Floor(up, float(offset), int(_count_near(heights, offset[None], size)) * area)


def _count_near(heights: Tensor, places: Tensor, size: float) -> Tensor:
    """Number of ascending heights (N,) that are at most a voxel above or below each place, (M,)."""
    return torch.searchsorted(heights, places + size, right=True) - torch.searchsorted(heights, places - size)
