"""Figure of an occupancy map from above: 2D grid with the camera path, and a horizontal slice of the distance field."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid, occupancy_grid
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState
from v3d_torch.types import Trajectory
from v3d_torch.viz.fonts import draw_title
from v3d_torch.viz.time_gaps import insert_gaps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STATE_COLOURS = {VoxelState.UNKNOWN: "#bdbdbd", VoxelState.FREE: "#ffffff", VoxelState.OCCUPIED: "#202020"}
"""Colour of each state in the 2D grid, as in viewers of ROS maps."""

_MARGIN = 0.25
"""Unknown border around the known space, metres."""

_MAX_PIXELS = 1000
"""Maximum number of rows or columns of the slice; large buildings are drawn more coarsely."""


def draw_occupancy(
    occupancy: OccupancyMap, trajectory: Trajectory, up: Tensor, floor: Floor | None, title: str = ""
) -> Figure:
    """Draw an occupancy map from above.

    The 2D grid is that of `occupancy_grid`. The slice of the distance field is horizontal, in the middle of the heights
    of obstacles. Without floor there is only the slice, at the median height of the camera.

    Args:
        occupancy: Map that is not empty.
        trajectory: Poses of all frames.
        up: Up direction without a floor, unit vector, world frame, float64, shape :math:`(3,)`.
        floor: Floor of the map, or None.
        title: Title of the figure.
    """
    T_lw = level_frame(up if floor is None else floor.up)
    path = _to_level(trajectory.T_wc[:, :3, 3], T_lw)
    known = _to_level(torch.cat([occupancy.occupied_points, occupancy.free_points]), T_lw)
    corners = torch.cat([path, known])[:, :2]
    low, high = corners.amin(dim=0) - _MARGIN, corners.amax(dim=0) + _MARGIN
    figure = Figure(figsize=(6.4 if floor is None else 11.0, 5.6), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(1, 1 if floor is None else 2, squeeze=False)[0])
    if floor is not None:
        _draw_grid(panels[0], occupancy_grid(occupancy, floor))
        bottom, top = occupancy.config.obstacle_heights
        panels[0].set_title(f"obstacles {bottom:.2f} to {top:.2f} m above the floor", fontsize=10)
    if floor is None:
        height, place = float(path[:, 2].median()), "at the height of the camera (no visible floor)"
    else:
        above = sum(occupancy.config.obstacle_heights) / 2
        height, place = floor.offset + above, f"{above:.2f} m above the floor"
    _draw_slice(panels[-1], occupancy, T_lw, height, low, high)
    panels[-1].set_title(f"distance to obstacles {place}", fontsize=10)
    for axes in panels:
        axes.plot(*insert_gaps(trajectory.stamps, path[:, :2]).T, color="tab:blue", linewidth=1.2, label="camera path")
        axes.plot(*path[:1, :2].T.numpy(), "o", color="tab:blue", markeredgecolor="white", label="start")
        axes.set_facecolor(STATE_COLOURS[VoxelState.UNKNOWN])
        (left, lower), (right, upper) = low.tolist(), high.tolist()
        axes.set(xlim=(left, right), ylim=(lower, upper), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    # Without a floor, free space is coloured by the distance to obstacles.
    for state in [each for each in VoxelState if floor is not None or each is not VoxelState.FREE]:
        colour = STATE_COLOURS[state]
        panels[0].plot([], [], "s", color=colour, markeredgecolor="gray", label=state.name.lower())
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    draw_title(figure.suptitle, title)
    return figure


def _draw_grid(axes: Axes, grid: OccupancyGrid) -> None:
    """Draw the states of a 2D grid."""
    (rows, columns), size, (x, y) = grid.states.shape, grid.cell_size, grid.origin
    if rows:
        colours = ListedColormap([STATE_COLOURS[state] for state in VoxelState])
        extent = (x, x + columns * size, y, y + rows * size)
        axes.imshow(grid.states.numpy(), cmap=colours, vmin=-1, vmax=1, origin="lower", extent=extent)


def _draw_slice(axes: Axes, occupancy: OccupancyMap, T_lw: Tensor, height: float, low: Tensor, high: Tensor) -> None:
    """Draw the distance to obstacles at a coordinate z of the level frame, with a contour every quarter of a metre."""
    step = max(occupancy.config.voxel_size, float((high - low).max()) / _MAX_PIXELS)
    (left, bottom), (right, top) = low.tolist(), high.tolist()
    x, y = (torch.arange(*ends, step, dtype=torch.float64) for ends in ((left, right), (bottom, top)))
    points = torch.stack([*torch.meshgrid(x, y, indexing="xy"), x.new_full((len(y), len(x)), height)], dim=-1)
    points = points @ T_lw[:3, :3]
    distance, maximum = occupancy.distance(points).numpy(), occupancy.config.max_distance
    edges = (left - step / 2, float(x[-1]) + step / 2, bottom - step / 2, float(y[-1]) + step / 2)
    image = axes.imshow(distance, vmin=0, vmax=maximum, cmap="viridis", origin="lower", extent=edges)
    if np.isfinite(distance).any():
        axes.contour(x, y, distance, np.arange(0.25, maximum, 0.25), colors="white", linewidths=0.6, alpha=0.7)
    occupied = np.where(occupancy.states(points).numpy() == VoxelState.OCCUPIED, 1.0, np.nan)
    black = ListedColormap([STATE_COLOURS[VoxelState.OCCUPIED]])
    axes.imshow(occupied, cmap=black, origin="lower", extent=edges)
    axes.figure.colorbar(image, ax=axes, label="m", shrink=0.8)


def _to_level(points: Tensor, T_lw: Tensor) -> Tensor:
    return points @ T_lw[:3, :3].T
