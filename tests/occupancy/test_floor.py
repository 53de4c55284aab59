"""Floor and up direction of rendered rooms with tables, and of maps without floor."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.box_room import ROOM
from helpers.occupancy_scenes import CONFIG, add_view, box_of_voxels, map_of
from torch import Tensor

from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.occupancy.floor import find_floor
from v3d_torch.occupancy.occupancy_map import OccupancyMap
from v3d_torch.occupancy.up_direction import UpDirection, estimate_up

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
TABLE = torch.tensor([[-1.2, 0.4, 0.6], [1.2, 0.45, 1.83]])
FLOOR = float(ROOM[1, 1])
"""Height of the floor below the camera; y points down."""


def looking_down(count: int, T_ow: Tensor | None = None) -> OccupancyMap:
    """Map of the room with a table, by a camera that turns and looks down; its world frame is rotated by ``T_ow``."""
    occupancy = OccupancyMap(CONFIG)
    turn, pitch = (torch.zeros(6, dtype=torch.float64) for _ in range(2))
    pitch[3] = -0.6
    for number in range(count):
        turn[4] = 2 * math.pi * number / count
        T_wc = se3_exp(turn) @ se3_exp(pitch)
        view_of = T_wc if T_ow is None else T_ow @ T_wc
        add_view(occupancy, number, T_wc, TABLE, pose_in_map=view_of)
    return occupancy


@pytest.fixture(scope="module")
def room() -> OccupancyMap:
    return looking_down(24)


def angle(first: Tensor, second: Tensor) -> float:
    return math.degrees(math.acos(min(float(first @ second), 1.0)))


def test_floor_is_found_below_the_table(room: OccupancyMap) -> None:
    floor = find_floor(room, estimate_up())
    assert floor is not None
    assert angle(floor.up, UP) < 1.0 and -floor.offset == pytest.approx(FLOOR, abs=0.03)
    assert 1.0 < floor.area < 10.0
    assert floor.height(torch.tensor([[0.0, FLOOR - 0.5, 0.3]])).item() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("twist", [(0.3, 0.0, 0.2), (-0.2, 1.0, 0.4), (0.5, -0.4, -0.3)])
def test_floor_of_a_tilted_world_is_found(twist: tuple[float, float, float]) -> None:
    T_ow = se3_exp(torch.tensor([0.3, -0.2, 0.5, *twist], dtype=torch.float64))
    floor = find_floor(looking_down(24, T_ow), UpDirection(UP, math.radians(45)))
    true = T_ow[:3, :3] @ UP
    assert floor is not None and angle(floor.up, true) < 2.0
    below = T_ow[:3, :3] @ torch.tensor([0.0, FLOOR, 1.0], dtype=torch.float64) + T_ow[:3, 3]
    assert abs(floor.height(below).item()) < 0.05


def test_floor_does_not_depend_on_the_order_of_the_blocks(room: OccupancyMap) -> None:
    shuffled = OccupancyMap(CONFIG)
    order = torch.randperm(len(room.blocks), generator=torch.Generator().manual_seed(0))
    state = room.blocks.state_dict()
    shuffled.load_state_dict({name: values[order] for name, values in state.items()})
    first, second = find_floor(room, estimate_up()), find_floor(shuffled, estimate_up())
    assert first is not None and second is not None
    assert angle(first.up, second.up) < 0.3 and first.offset == pytest.approx(second.offset, abs=0.01)


def test_table_without_visible_floor_is_taken_as_floor_only_if_nothing_is_below() -> None:
    table = box_of_voxels((0, 0, 0), (30, 1, 30))
    above = box_of_voxels((0, -10, 0), (30, 0, 30))
    floor = find_floor(map_of(table, above), estimate_up())
    assert floor is not None and floor.offset == pytest.approx(-0.025, abs=1e-6) and angle(floor.up, UP) < 1e-3
    below, gap = box_of_voxels((40, 12, 0), (60, 13, 30)), box_of_voxels((40, 2, 0), (60, 12, 30))
    floor = find_floor(map_of(torch.cat([table, below]), torch.cat([above, gap])), estimate_up())
    assert floor is not None and floor.offset == pytest.approx(-0.625, abs=1e-6)


def test_table_is_no_floor_if_its_legs_and_walls_reach_below_it() -> None:
    table, above = box_of_voxels((0, 0, 0), (30, 1, 30)), box_of_voxels((0, -10, 0), (30, 0, 30))
    wall = box_of_voxels((0, 4, 40), (30, 14, 41))  # no voxel below the table faces up
    assert find_floor(map_of(torch.cat([table, wall]), above), estimate_up()) is None


def test_desk_and_things_of_almost_the_same_height_do_not_tilt_the_up_direction() -> None:
    """The tops of a chair, a desk with a book on it, and a cupboard differ by a voxel each."""
    tops = {(-22, 1, 2): (-2, 14), (10, 0, 0): (30, 16), (42, -1, 0): (62, 12), (0, 15, 0): (8, 30)}
    occupied = [box_of_voxels((x, y, z), (last_x, y + 1, last_z)) for (x, y, z), (last_x, last_z) in tops.items()]
    free = [box_of_voxels((x, y - 8, z), (last_x, y, last_z)) for (x, y, z), (last_x, last_z) in tops.items()]
    book = box_of_voxels((20, -1, 6), (24, 0, 9))
    floor = find_floor(map_of(torch.cat([*occupied, book]), torch.cat(free)), estimate_up())
    assert floor is not None and angle(floor.up, UP) < 0.2 and floor.offset == pytest.approx(-0.775, abs=0.02)


def test_ceiling_is_no_floor() -> None:
    ceiling, free = box_of_voxels((0, 0, 0), (40, 1, 40)), box_of_voxels((0, 1, 0), (40, 12, 40))
    assert find_floor(map_of(ceiling, free), estimate_up()) is None


def test_wall_is_no_floor() -> None:
    """Also not by the tilted normals at the edges of what the camera sees."""
    occupancy = OccupancyMap(CONFIG)
    for number in range(20):
        add_view(occupancy, number, torch.eye(4, dtype=torch.float64))
    assert find_floor(occupancy, estimate_up()) is None


@pytest.mark.parametrize("side", [0, 1, 4])
def test_map_without_or_with_a_small_floor_has_none(side: int) -> None:
    floor = box_of_voxels((0, 0, 0), (side, 1, side))
    assert find_floor(map_of(floor, box_of_voxels((0, -3, 0), (9, 0, 9))), estimate_up()) is None


def test_up_direction_comes_from_the_most_accurate_source() -> None:
    gravity, votes = torch.tensor([0.0, 2.0, -0.1]), torch.tensor([9.0, 0.0, 1.0])
    assert estimate_up().direction.tolist() == [0.0, -1.0, 0.0]
    assert estimate_up(votes=votes / 9).direction.tolist() == [0.0, -1.0, 0.0]  # too few
    for up, vector in ((estimate_up(votes=votes), votes), (estimate_up(gravity, votes), -gravity)):
        torch.testing.assert_close(up.direction, vector.double() / vector.double().norm())
    assert estimate_up(gravity).tolerance < estimate_up(votes=votes).tolerance == estimate_up().tolerance
