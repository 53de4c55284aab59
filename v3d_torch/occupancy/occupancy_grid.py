"""2D occupancy grid above the floor of an occupancy map, for planners of wheeled robots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.argument_checks import check_shape
from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState

_MIN_FREE = 0.5
"""Minimum fraction of the heights above a free cell that was observed as free; a single ray high above it is not
enough."""


@dataclass(frozen=True)
class OccupancyGrid:
    """Cells of the floor with the state of the space above them.

    Attributes:
        states: Values of `VoxelState`, int8, shape :math:`(H, W)`: row along y, column along x, from the smallest
            coordinates on.
        cell_size: Side of a cell, metres.
        origin: Coordinates (x, y) of the corner of the first cell, level frame, metres.
        T_lw: World to the level frame of the floor, see `level_frame`, float64, shape :math:`(4, 4)`.
        height: Coordinate z of the floor, level frame, metres; that of the first camera is 0.
    """

    states: Tensor
    cell_size: float
    origin: tuple[float, float]
    T_lw: Tensor
    height: float

    def states_below(self, points: Tensor) -> Tensor:
        """State of the cell below or above each point.

        Args:
            points: Points, world frame, metres, shape :math:`(..., 3)`.

        Returns:
            Values of `VoxelState`, int8, shape :math:`(...)`; unknown outside of the grid, and for points that are not
            finite.

        Raises:
            InputError: If the points are no tensor.
        """
        check_shape("points", points, "*", 3)
        level = points.detach().to(torch.float64) @ self.T_lw[:2, :3].T + self.T_lw[:2, 3]
        cell = ((level - torch.tensor(self.origin, dtype=torch.float64)) / self.cell_size).floor()
        rows, columns = self.states.shape
        inside = ((cell >= 0) & (cell < torch.tensor([columns, rows]))).all(dim=-1)
        states = torch.full(inside.shape, VoxelState.UNKNOWN, dtype=torch.int8)
        column, row = cell[inside].to(torch.int64).unbind(dim=-1)
        states[inside] = self.states[row, column]
        return states


def occupancy_grid(
    occupancy: OccupancyMap, floor: Floor | None, heights: tuple[float, float] | None = None
) -> OccupancyGrid:
    """Project an occupancy map onto its floor.

    A cell is occupied if the centre of any occupied voxel between the heights lies above it. It is free if it is not
    occupied and at least half of the space between the heights was observed as free.

    Args:
        occupancy: Map.
        floor: Floor of the map, see `find_floor`.
        heights: Lowest and highest obstacle, metres above the floor; None for those of the configuration.

    Raises:
        InputError: If the floor is None, because none was found.
        ConfigError: If the lowest height is not below the highest, or a height is not finite.
    """
    if floor is None:
        raise InputError("a grid needs a floor, and none was found; let the camera see the floor")
    size, (low, high) = occupancy.config.voxel_size, heights or occupancy.config.obstacle_heights
    if not -math.inf < low < high < math.inf:
        raise ConfigError(f"heights ({low}, {high}): give the lowest obstacle first, then the highest, both finite")
    T_lw, low, high = level_frame(floor.up), low + floor.offset, high + floor.offset
    occupied = torch.cat(
        [_between(points, T_lw, low, high) for points in occupancy.points_by_chunk(VoxelState.OCCUPIED)]
    )
    free = [_extent(_between(points, T_lw, low, high)) for points in occupancy.points_by_chunk(VoxelState.FREE)]
    known = torch.cat([occupied, *free])
    if len(known) == 0:
        return OccupancyGrid(torch.zeros(0, 0, dtype=torch.int8), size, (0.0, 0.0), T_lw, floor.offset)
    first = (known.amin(dim=0) / size).floor().to(torch.int64)
    columns, rows = ((known.amax(dim=0) / size).floor().to(torch.int64) - first + 1).tolist()
    centres = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).flip(1).to(torch.float64)
    centres = (centres + first + 0.5) * size
    levels = torch.arange(low + min(size, high - low) / 2, high, size, dtype=torch.float64)
    count = torch.zeros(len(centres), dtype=torch.int64)
    for z in levels.tolist():
        points = torch.cat([centres, centres.new_full((len(centres), 1), z)], dim=1)
        count += occupancy.states(points @ T_lw[:3, :3]) == VoxelState.FREE
    states = torch.where(count >= _MIN_FREE * len(levels), VoxelState.FREE, VoxelState.UNKNOWN).to(torch.int8)
    column, row = ((occupied / size).floor().to(torch.int64) - first).unbind(dim=1)
    states[row * columns + column] = VoxelState.OCCUPIED
    x, y = (number * size for number in first.tolist())  # as a tensor the product would be in single precision
    return OccupancyGrid(states.reshape(rows, columns), size, (x, y), T_lw, floor.offset)


def _between(points: Tensor, T_lw: Tensor, low: float, high: float) -> Tensor:
    """Coordinates x and y of the world points (N, 3) between two coordinates z, level frame, (M, 2)."""
    level = points @ T_lw[:3, :3].T
    return level[(level[:, 2] >= low) & (level[:, 2] <= high), :2]


def _extent(points: Tensor) -> Tensor:
    """Smallest and largest coordinates of points (N, 2), (2, 2); (0, 2) if there are no points."""
    return torch.stack(points.aminmax(dim=0)) if len(points) else points
