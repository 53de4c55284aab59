"""Floor of an occupancy map: the lowest horizontal plane, by consensus of the normals and heights of its voxels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from v3d_torch.geometry.long_products import sum_products
from v3d_torch.objects.dbscan import dbscan
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState
from v3d_torch.occupancy.up_direction import UpDirection

_MAX_VOXELS = 4096
"""Maximum number of voxels that are used, to bound the time; a larger number is subsampled."""

_MAX_CANDIDATES = 256
"""Maximum number of normals that are tested as up direction; a larger number is subsampled."""

_NORMAL_RADIUS = 2
"""Radius of the neighbourhood whose states determine the normal of a voxel, voxels."""

_DIRECTION_TOLERANCE = math.radians(10)
"""Maximum error of the normal of a single voxel, radians; it is large, because the states around a voxel are coarse."""

_FACING_TOLERANCE = math.radians(30)
"""Maximum angle between up and the normal of a voxel of the floor, radians; near a wall the normal is tilted."""

_MIN_VOXELS = 30
"""Minimum number of voxels for a direction or a plane."""

_MAX_LAYERS = 6
"""Maximum number of layers with horizontal surfaces: floor, tables, shelves."""

_MIN_AREA = 0.25
"""Minimum visible area of a floor, square metres; steps and boxes are smaller."""

_MAX_BELOW = 0.2
"""Maximum number of occupied voxels below the floor, as a fraction of the voxels of the floor: below a table there are
more, such as its legs, walls and the floor."""

_BELOW_MARGIN = 2
"""Minimum distance of voxels that count as below the floor, voxels: the floor itself is up to three voxels high."""

_MAX_GAP = 3
"""Maximum gap between the voxels of one surface, voxels; times the square root of the step of a subsample, which thins
surfaces."""

_REFINEMENTS = 3
"""Number of times that direction and planes are refitted to their voxels."""


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

        Returns:
            Heights, float64, shape :math:`(...)`.
        """
        return points.to(torch.float64) @ self.up - self.offset


def find_floor(occupancy: OccupancyMap, up: UpDirection) -> Floor | None:
    """Find the floor of a map.

    The up direction is the normal with which most other normals agree: the normals of floor, tables and ceiling are
    parallel. Then the layers with the most voxels that face up are found, and parallel planes are fitted to the
    connected surfaces of all layers, because often only a small part of the floor is visible. The floor is the lowest
    layer that is large enough and has few occupied voxels below it. All voxels are hypotheses, so the result is
    deterministic.

    Args:
        occupancy: Occupancy map.
        up: Approximate up direction, see `estimate_up`.

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
    facing = points[normals @ direction > math.cos(_FACING_TOLERANCE)]
    for _ in range(_REFINEMENTS):
        layers = _find_layers(facing @ direction, size)
        surfaces = [surface for layer in layers for surface in _split(facing[layer], _MAX_GAP * size * math.sqrt(step))]
        direction = _fit_normal(surfaces, size, direction)
    if direction @ up.direction < math.cos(up.tolerance):
        return None
    return _lowest_layer(facing @ direction, points @ direction, direction, size, step * size**2)


def _voxel_normals(occupancy: OccupancyMap, points: Tensor) -> Tensor:
    """Unit directions from occupied voxels, (N, 3), to the free space around them; 0 without free space."""
    steps = torch.arange(-_NORMAL_RADIUS, _NORMAL_RADIUS + 1) * occupancy.config.voxel_size
    offsets = torch.cartesian_prod(*3 * [steps.to(torch.float64)])
    free = occupancy.states(points[:, None] + offsets) == VoxelState.FREE
    return normalize(free.to(torch.float64) @ normalize(offsets, dim=1), dim=1)


def _common_direction(normals: Tensor, up: UpDirection) -> Tensor | None:
    """Direction near up, (3,), to which most normals are parallel or antiparallel; None if too few are."""
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


def _find_layers(heights: Tensor, size: float) -> list[Tensor]:
    """Masks of the points of each layer, (N,) each, sorted by number of points; a layer is two voxels high."""
    free, layers = torch.ones_like(heights, dtype=torch.bool), []
    for _ in range(_MAX_LAYERS):
        own = heights[free].sort().values
        counts = _count_near(own, own, size)
        if len(own) == 0 or int(counts.max()) < _MIN_VOXELS:
            break
        layer = free & ((heights - own[int(counts.argmax())]).abs() <= size)
        layers.append(layer)
        free = free & ~layer
    return layers


def _split(layer: Tensor, gap: float) -> list[Tensor]:
    """Split the points (N, 3) of a layer into connected surfaces, (M, 3) each: tables can differ by a voxel."""
    labels = dbscan(layer[None], torch.ones(1, len(layer), dtype=torch.bool), gap, min_samples=1)[0]
    surfaces = [layer[labels == label] for label in labels.unique()]
    return [surface for surface in surfaces if len(surface) >= _MIN_VOXELS]


def _fit_normal(surfaces: list[Tensor], size: float, direction: Tensor) -> Tensor:
    """Common normal of the planes through the points, (M, 3) each, of each surface."""
    scatter = size**2 * torch.eye(3, dtype=direction.dtype)
    for surface in surfaces:
        centred = surface - surface.mean(dim=0)
        scatter = scatter + sum_products(centred, centred)
    normal = torch.linalg.eigh(scatter).eigenvectors[:, 0]
    return normal * (normal @ direction).sign() if surfaces else direction


def _lowest_layer(heights: Tensor, occupied: Tensor, up: Tensor, size: float, area: float) -> Floor | None:
    """Lowest layer with enough voxels that face up and few occupied voxels below it.

    Args:
        heights: Heights of the voxels that face up, (N,).
        occupied: Heights of all occupied voxels, (M,).
        up: Up direction, (3,).
        size: Side of a voxel, metres.
        area: Area that each voxel covers, square metres.
    """
    heights = heights.sort().values
    counts = _count_near(heights, heights, size)
    below = torch.searchsorted(occupied.sort().values, heights - _BELOW_MARGIN * size)
    is_floor = (counts >= _MIN_VOXELS) & (counts * area >= _MIN_AREA) & (below <= _MAX_BELOW * counts)
    if not bool(is_floor.any()):
        return None
    # The lowest voxels of a floor are noise; the height of the floor is that of most voxels.
    near = heights <= heights[is_floor][0] + 2 * size
    offset = heights[int(torch.where(near, counts, 0).argmax())]
    offset = heights[(heights - offset).abs() <= size].mean()
    return Floor(up, float(offset), int(_count_near(heights, offset[None], size)) * area)


def _count_near(heights: Tensor, places: Tensor, size: float) -> Tensor:
    """Number of ascending heights (N,) that are at most a voxel above or below each place, (M,)."""
    return torch.searchsorted(heights, places + size, right=True) - torch.searchsorted(heights, places - size)
