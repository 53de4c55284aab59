"""Occupancy map in a rerun recording: occupied voxels, and the free cells of the floor."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import rerun as rr
import torch

from v3d_torch.occupancy.occupancy_grid import OccupancyGrid
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState
from v3d_torch.viz.rerun.objects import rgba

_HEIGHT_RANGE = 2.5
"""Range of heights that the colours of voxels cover, metres: the height of a room."""


def log_voxels(stream: rr.RecordingStream, occupancy: OccupancyMap) -> None:
    """Log the occupied voxels, coloured by their height above the first camera, as if that camera had been level.

    Args:
        stream: Recording.
        occupancy: Map.
    """
    points = occupancy.occupied_points.numpy()
    heights = (-points[:, 1] / _HEIGHT_RANGE + 0.5).clip(0, 1)
    colours = (255 * mpl.colormaps["viridis"](heights)).astype(np.uint8)
    stream.log("world/occupancy", rr.Points3D(points, colors=colours, radii=occupancy.config.voxel_size / 2))


def log_floor(stream: rr.RecordingStream, grid: OccupancyGrid) -> None:
    """Log the free cells of the 2D grid as points on the floor.

    Args:
        stream: Recording.
        grid: 2D grid.
    """
    row, column = torch.nonzero(grid.states == VoxelState.FREE).unbind(dim=1)
    cells = torch.stack([column, row], dim=1).to(torch.float64) + 0.5
    xy, z = cells * grid.cell_size + cells.new_tensor(grid.origin), cells.new_full((len(cells), 1), grid.height)
    points = torch.cat([xy, z], dim=1) @ grid.T_lw[:3, :3]
    free = rr.Points3D(points.numpy(), colors=[rgba("tab:green")], radii=grid.cell_size / 2)
    stream.log("world/occupancy/floor", free)
