"""Figure of an occupancy map: panels with and without a floor, colours of the states, camera path."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers.occupancy_scenes import CONFIG, add_view
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState
from v3d_torch.types import Trajectory
from v3d_torch.viz.occupancy_figure import STATE_COLOURS, draw_occupancy

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def room() -> tuple[OccupancyMap, Trajectory]:
    occupancy, poses = OccupancyMap(CONFIG), []
    for number in range(24):
        twist = torch.tensor([0.0, 0.0, 0.0, 0.0, 2 * math.pi * number / 24, 0.0], dtype=torch.float64)
        poses.append(se3_exp(twist))
        add_view(occupancy, number, poses[-1])
    return occupancy, Trajectory(torch.arange(24, dtype=torch.float64), torch.stack(poses))


def pixels(figure: Figure) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]


def test_grid_and_slice_show_the_room_from_above(room: tuple[OccupancyMap, Trajectory]) -> None:
    figure = draw_occupancy(*room, UP, Floor(UP, -1.17, 3.0), "room $1")
    grid, distances = figure.axes[:2]
    assert "obstacles 0.15 to 1.80 m" in grid.get_title() and "0.97 m above the floor" in distances.get_title()
    assert grid.get_xlim() == distances.get_xlim() and grid.get_xlabel() == "x [m]"
    assert grid.get_xlim()[0] < -1.47 and grid.get_xlim()[1] > 1.83  # x is forward: the walls behind and ahead
    image = pixels(figure)
    left = image[:, : image.shape[1] // 2]
    for state in VoxelState:
        colour = np.round(255 * np.array(to_rgb(STATE_COLOURS[state])))
        assert (np.abs(left - colour).max(axis=2) <= 1).sum() > 1000, state
    slice_of = distances.get_images()[0].get_array()
    assert slice_of.max() <= CONFIG.max_distance and np.ma.masked_invalid(slice_of).mask.any()


def test_without_floor_only_the_slice_is_drawn(room: tuple[OccupancyMap, Trajectory]) -> None:
    figure = draw_occupancy(*room, UP, None)
    assert len(figure.axes) == 2  # with the colour bar
    assert "no visible floor" in figure.axes[0].get_title()
    assert pixels(figure).std() > 10


def test_camera_path_has_gap_where_there_are_no_frames(room: tuple[OccupancyMap, Trajectory]) -> None:
    occupancy, trajectory = room
    stamps = trajectory.stamps + 100 * (trajectory.stamps >= 10)
    path = draw_occupancy(occupancy, Trajectory(stamps, trajectory.T_wc), UP, None).axes[0].lines[0]
    assert np.flatnonzero(np.isnan(path.get_xdata())).tolist() == [10]


def test_map_of_a_single_view_and_a_map_without_free_space_are_drawn() -> None:
    occupancy = OccupancyMap(CONFIG)
    eye = torch.eye(4, dtype=torch.float64)
    occupancy.integrate(torch.full((2, 2), 0.01), torch.ones(2, 2, dtype=torch.bool), torch.ones(2, 2, 3), eye)
    path = Trajectory(torch.zeros(1, dtype=torch.float64), eye[None])
    for floor in (None, Floor(UP, -1.0, 1.0)):
        assert pixels(draw_occupancy(occupancy, path, UP, floor)).std() > 0
