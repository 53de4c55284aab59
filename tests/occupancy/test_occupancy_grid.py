"""2D grids of chosen voxels and of a rendered room, and their files for map_server."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from helpers.box_room import ROOM
from helpers.occupancy_scenes import CONFIG, add_view, box_of_voxels, map_of
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError, InputError, OutputError
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels.voxel_blocks import VOLUME
from v3d_torch.occupancy import voxel_blocks
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.map_server import write_map_server_files
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid, occupancy_grid
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState

SIZE = CONFIG.voxel_size
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
FLOOR = Floor(UP, 0.0, 1.0)
"""Floor at y = 0; y points down."""
HEIGHTS = (0.1, 0.5)
"""Voxels with y from -10 to -3: eight above each cell."""


@pytest.fixture(scope="module")
def chosen() -> OccupancyGrid:
    """Free space 20 voxels wide and 12 deep, with a low obstacle, a high one, one above the heights, and a gap."""
    free = box_of_voxels((0, -12, 0), (20, -1, 12))
    low, high = box_of_voxels((2, -3, 3), (4, -2, 5)), box_of_voxels((8, -10, 3), (9, -9, 4))
    lamp, gap = box_of_voxels((12, -12, 6), (14, -11, 8)), box_of_voxels((16, -11, 8), (18, -5, 10))
    floor = box_of_voxels((0, -1, 0), (20, 0, 12))
    occupied = torch.cat([low, high, lamp, floor])
    taken = {tuple(voxel) for voxel in torch.cat([occupied, gap]).tolist()}
    free = torch.tensor([voxel for voxel in free.tolist() if tuple(voxel) not in taken])
    return occupancy_grid(map_of(occupied, free), FLOOR, HEIGHTS)


def state_below(grid: OccupancyGrid, point: Tensor) -> int:
    """State of the cell below a point of the world, computed from the attributes; unknown outside of the grid."""
    level = grid.T_lw[:2, :3] @ point - torch.tensor(grid.origin, dtype=torch.float64)
    column, row = (level / grid.cell_size).floor().long().tolist()
    is_inside = 0 <= row < grid.states.shape[0] and 0 <= column < grid.states.shape[1]
    return int(grid.states[row, column]) if is_inside else VoxelState.UNKNOWN


def state_above(grid: OccupancyGrid, x: float, z: float) -> int:
    """State of the cell below a point, in voxels."""
    return state_below(grid, torch.tensor([(x + 0.5) * SIZE, -0.3, (z + 0.5) * SIZE], dtype=torch.float64))


def test_cells_have_the_states_of_the_space_above_them(chosen: OccupancyGrid) -> None:
    assert (chosen.states == VoxelState.OCCUPIED).sum() == 5  # four below the low obstacle, one below the high one
    assert [state_above(chosen, *place) for place in ((2, 3), (3, 4), (8, 3))] == 3 * [VoxelState.OCCUPIED]
    assert [state_above(chosen, *place) for place in ((0, 0), (12, 6), (4, 3))] == 3 * [VoxelState.FREE]
    assert [state_above(chosen, *place) for place in ((16, 8), (17, 9), (-1, 3), (3, 12))] == 4 * [VoxelState.UNKNOWN]


def test_convention_x_is_forward_and_y_is_left(chosen: OccupancyGrid) -> None:
    """The first camera looks along z of the world, and its x points right."""
    assert chosen.states.shape == (20, 12) and chosen.origin == pytest.approx((0.0, -20 * SIZE))
    ahead_left = torch.tensor([-1.0, -0.5, 2.0], dtype=torch.float64)
    level = chosen.T_lw[:3, :3] @ ahead_left + chosen.T_lw[:3, 3]
    torch.testing.assert_close(level, torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64))
    row, column = 20 - 1 - 8, 3
    assert chosen.states[row, column] == VoxelState.OCCUPIED  # the high obstacle, 8 voxels to the right, 3 ahead


def test_floor_is_at_its_height_below_the_first_camera() -> None:
    """Cells do not depend on where the world's origin is; their height is that of the floor."""
    voxels = box_of_voxels((0, -12, 0), (20, -1, 12))
    below = torch.tensor([0, 26, 0])
    nothing = torch.zeros(0, 3, dtype=torch.int64)
    grid, lower = (
        occupancy_grid(map_of(nothing, voxels + shift), Floor(UP, -float(shift[1]) * SIZE, 1.0), HEIGHTS)
        for shift in (0 * below, below)
    )
    assert torch.equal(grid.states, lower.states) and grid.origin == lower.origin and grid.height == 0
    assert lower.height == pytest.approx(-26 * SIZE)


def grid_of_room(T_ow: Tensor) -> OccupancyGrid:
    occupancy = OccupancyMap(CONFIG)
    turn = torch.zeros(6, dtype=torch.float64)
    for number in range(36):
        turn[4] = 2 * math.pi * number / 36
        add_view(occupancy, number, se3_exp(turn), pose_in_map=T_ow @ se3_exp(turn))
    up = T_ow[:3, :3] @ UP
    below = T_ow[:3, :3] @ torch.tensor([0.0, float(ROOM[1, 1]), 0.0], dtype=torch.float64) + T_ow[:3, 3]
    return occupancy_grid(occupancy, Floor(up, float(up @ below), 1.0), (1.0, 1.35))


@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.0), (0.35, 0.5, 0.25)])
def test_grid_of_a_room_shows_its_walls_also_in_a_tilted_world(twist: tuple[float, float, float]) -> None:
    T_ow = se3_exp(torch.tensor([0.1, 0.2, 0.3, *twist], dtype=torch.float64))
    grid = grid_of_room(T_ow)

    def state(x: float, z: float) -> int:
        point = T_ow[:3, :3] @ torch.tensor([x, 0.0, z], dtype=torch.float64) + T_ow[:3, 3]
        return state_below(grid, point)

    (left, _, back), (right, _, front) = ROOM.tolist()
    inside = [(x, z) for x in np.linspace(left + 0.2, right - 0.2, 9) for z in np.linspace(back + 0.2, front - 0.2, 9)]
    assert sum(state(x, z) == VoxelState.FREE for x, z in inside) > 0.95 * len(inside)
    walls = [(left, z) for z in np.linspace(back + 0.2, front - 0.2, 20)] + [
        (x, front) for x in np.linspace(left + 0.2, right - 0.2, 20)
    ]
    near_walls = [{state(x + i * SIZE, z + j * SIZE) for i in (-1, 0, 1) for j in (-1, 0, 1)} for x, z in walls]
    assert all(VoxelState.OCCUPIED in states for states in near_walls)
    assert state(right + 0.3, 0.0) == VoxelState.UNKNOWN


@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.0), (0.35, 0.5, 0.25)])
def test_states_below_points_follow_the_conventions_of_the_grid(twist: tuple[float, float, float]) -> None:
    """Also in a tilted world, at any height, and outside of the grid, where the cells are unknown."""
    T_ow = se3_exp(torch.tensor([0.1, 0.2, 0.3, *twist], dtype=torch.float64))
    grid = grid_of_room(T_ow)
    points = 8 * torch.rand(40, 50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 4
    states = grid.states_below(points)
    assert states.shape == (40, 50) and states.dtype == torch.int8
    assert states.flatten().tolist() == [state_below(grid, point) for point in points.view(-1, 3)]
    assert len(states.unique()) == 3
    assert grid.states_below(points[0, 0]).item() == states[0, 0]
    assert torch.equal(grid.states_below(points.float().requires_grad_())[:2], grid.states_below(points.float())[:2])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_states_below_points_that_are_not_finite_or_very_far_away_are_unknown(
    bad: float, chosen: OccupancyGrid
) -> None:
    points = torch.tensor([[bad, 0.0, 0.1], [0.1, bad, 0.1], [0.1, 0.0, bad]])
    assert chosen.states_below(points)[[0, 2]].tolist() == 2 * [VoxelState.UNKNOWN]
    empty = occupancy_grid(OccupancyMap(CONFIG), FLOOR)
    assert empty.states_below(points.new_zeros(2, 3)).tolist() == 2 * [VoxelState.UNKNOWN]


def test_points_without_three_coordinates_have_no_states(chosen: OccupancyGrid) -> None:
    with pytest.raises(ShapeError, match=r"^points has the shape \(4, 2\)"):
        chosen.states_below(torch.ones(4, 2))
    with pytest.raises(InputError, match=r"^points is of type ndarray; give a torch.Tensor"):
        chosen.states_below(np.ones((4, 3)))  # type: ignore[arg-type]


def test_map_without_a_floor_has_no_grid() -> None:
    with pytest.raises(InputError, match=r"^a grid needs a floor, and none was found; let the camera see the floor$"):
        occupancy_grid(OccupancyMap(CONFIG), None)


def test_grid_does_not_depend_on_the_size_of_the_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    occupancy = map_of(box_of_voxels((30, -5, 3), (33, -3, 40)), box_of_voxels((-20, -12, -20), (30, -1, 50)))
    whole = occupancy_grid(occupancy, FLOOR, HEIGHTS)
    monkeypatch.setattr(voxel_blocks, "_CHUNK_BLOCKS", 1)
    parts = occupancy_grid(occupancy, FLOOR, HEIGHTS)
    assert torch.equal(parts.states, whole.states) and parts.origin == whole.origin
    assert len(whole.states.unique()) == 3


def test_grid_needs_no_points_of_the_whole_map(monkeypatch: pytest.MonkeyPatch) -> None:
    occupancy, sizes = map_of(torch.zeros(0, 3, dtype=torch.int64), box_of_voxels((-20, -12, -20), (30, -1, 50))), []
    voxels_where = voxel_blocks.VoxelBlocks.voxels_where

    def measured(blocks: voxel_blocks.VoxelBlocks, mask: Tensor) -> Tensor:
        sizes.append(mask.numel())
        return voxels_where(blocks, mask)

    monkeypatch.setattr(voxel_blocks, "_CHUNK_BLOCKS", 2)
    monkeypatch.setattr(voxel_blocks.VoxelBlocks, "voxels_where", measured)
    occupancy_grid(occupancy, FLOOR, HEIGHTS)
    assert len(occupancy.blocks) > 4 and max(sizes) == 2 * VOLUME


@pytest.mark.parametrize("heights", [(0.5, 0.5), (1.0, 0.2), (0.1, math.nan), (0.1, math.inf)])
def test_heights_in_the_wrong_order_or_without_a_bound_are_rejected(heights: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match="give the lowest obstacle first"):
        occupancy_grid(OccupancyMap(CONFIG), FLOOR, heights)
    values = str(list(heights)).replace("nan", ".nan").replace("inf", ".inf")
    with pytest.raises(ConfigError, match=r"occupancy\.obstacle_heights: .*lowest height should be below"):
        load_config(overrides=[f"occupancy.obstacle_heights={values}"])


def test_heights_closer_than_a_voxel_use_the_space_between_them() -> None:
    occupancy = map_of(torch.tensor([[3, -5, 3]]), box_of_voxels((0, -5, 0), (3, -4, 3)))
    grid = occupancy_grid(occupancy, FLOOR, (0.21, 0.24))
    assert state_above(grid, 1, 1) == VoxelState.FREE and state_above(grid, 3, 3) == VoxelState.OCCUPIED


def test_map_without_space_between_the_heights_gives_an_empty_grid(tmp_path: Path) -> None:
    grid = occupancy_grid(map_of(box_of_voxels((0, 0, 0), (3, 1, 3)), torch.zeros(0, 3, dtype=torch.int64)), FLOOR)
    assert grid.states.shape == (0, 0)
    write_map_server_files(tmp_path / "map.yaml", grid)


def test_map_server_reads_the_states_from_the_files(chosen: OccupancyGrid, tmp_path: Path) -> None:
    """As nav2_map_server's map_io.cpp does in trinary mode."""
    write_map_server_files(tmp_path / "map.yaml", chosen)
    about = yaml.safe_load((tmp_path / "map.yaml").read_text())
    image = cv2.imread(str(tmp_path / about["image"]), cv2.IMREAD_UNCHANGED)
    assert about["mode"] == "trinary" and about["negate"] == 0 and image.dtype == np.uint8
    assert about["resolution"] == SIZE and about["origin"] == pytest.approx([*chosen.origin, 0.0])
    occupancy = (255 - image.astype(float)) / 255
    unknown = np.full(image.shape, VoxelState.UNKNOWN)
    states = np.where(occupancy > about["occupied_thresh"], VoxelState.OCCUPIED, unknown)
    states = np.where(occupancy < about["free_thresh"], VoxelState.FREE, states)
    assert np.array_equal(states[::-1], chosen.states.numpy())  # the last row of the image has the smallest y


@pytest.mark.parametrize("name", ["map.pgm", "map"])
def test_name_of_another_suffix_is_an_output_error(name: str, chosen: OccupancyGrid, tmp_path: Path) -> None:
    """The description replaced an image of the same name."""
    with pytest.raises(OutputError, match=rf"{name}: is not the name of a YAML file; choose a name that ends in .yaml"):
        write_map_server_files(tmp_path / name, chosen)
    assert list(tmp_path.iterdir()) == []


def test_origin_is_written_without_rounding_errors(tmp_path: Path) -> None:
    grid = occupancy_grid(map_of(torch.tensor([[-4, -5, -4]]), torch.zeros(0, 3, dtype=torch.int64)), FLOOR, HEIGHTS)
    write_map_server_files(tmp_path / "map.yaml", grid)
    assert "origin: [-0.2, 0.15, 0.0]\n" in (tmp_path / "map.yaml").read_text()
    assert grid.origin[0] == -0.2  # in double precision, as the coordinates of the cells


def test_error_names_the_file_that_cannot_be_written(chosen: OccupancyGrid, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"map\.pgm: cannot be written"):
        write_map_server_files(tmp_path / "file" / "map.yaml", chosen)
