"""Growth of the occupancy map: frames that are added, rebuilds after corrections, bounded memory, saved state."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from helpers.box_room import CAMERA, CRATE, keyframe, looking_around, render
from helpers.waiting import steps_until
from torch import Tensor

from v3d_torch.config import OccupancyConfig
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.io.state_file import read_state, write_state
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_map import OccupancyMap
from v3d_torch.occupancy.occupancy_mapper import OccupancyMapper
from v3d_torch.occupancy.range_view import RangeView
from v3d_torch.occupancy.up_direction import UpDirection, estimate_up
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.runs.state import STATE_CLASSES
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import FramePose, TrackingStatus

CONFIG = OccupancyConfig(interval=1)
ALL = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
POSES = looking_around(36)
HERE = torch.eye(4, dtype=torch.float64)
SHIFT = se3_exp(torch.tensor([0.2, 0.0, 0.1, 0.0, 0.1, 0.0], dtype=torch.float64))
MOTION = CameraMotion(HERE, torch.zeros(6, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.int64), False)


class Drive:
    """Camera that turns in the room; the first half of its poses is relative to one keyframe, the rest to another."""

    def __init__(self, mapper: OccupancyMapper) -> None:
        self.mapper = mapper
        self.keyframes = [keyframe(invert(POSES[0])), keyframe(invert(POSES[18]), frame=18)]
        self.poses = PoseHistory()

    def add(
        self,
        first: int,
        last: int,
        status: TrackingStatus = TrackingStatus.TRACKED,
        up: UpDirection | None = None,
        T_dc: Tensor | None = None,
    ) -> None:
        """Add frames; what the camera sees does not depend on the corrections of the keyframes."""
        for index in range(first, last):
            own = self.keyframes[index // 18 % 2]
            T_cw = invert(POSES[index % 36]) @ POSES[18 * (index // 18 % 2)] @ own.T_cw
            self.poses.append(index / 30, FramePose(status, T_cw, torch.zeros(0).long()), MOTION, own, None)
            self.mapper(render(POSES[index % 36], CRATE), ALL, self.poses, up, T_dc)

    def correct(self, row: int = 0, shift: Tensor = SHIFT) -> None:
        """Move a keyframe, as bundle adjustment and loop closing do."""
        self.keyframes[row].T_cw = self.keyframes[row].T_cw @ shift


def is_rebuilding(mapper: OccupancyMapper) -> bool:
    """Check whether the map is being rebuilt after a correction of the poses."""
    return mapper._rebuilt is not None


def same_map(first: OccupancyMap, second: OccupancyMap) -> bool:
    """Check whether two maps have the same voxels, in any order of the blocks."""
    a, b = first.blocks, second.blocks
    return torch.equal(a.keys, b.keys) and torch.equal(a.log_odds[a.rows], b.log_odds[b.rows])


def test_every_nth_reliable_frame_is_added() -> None:
    drive = Drive(OccupancyMapper(CONFIG.model_copy(update={"interval": 3}), CAMERA))
    drive.add(0, 7)
    assert drive.mapper._store.frames == [0, 3, 6]
    drive.add(7, 13, TrackingStatus.LOST)
    drive.keyframes[0].part = 1
    drive.add(13, 17, TrackingStatus.DISCONNECTED)
    assert drive.mapper._store.frames == [0, 3, 6]
    drive.keyframes[0].part = 0
    drive.add(17, 19, TrackingStatus.ODOMETRY)
    assert drive.mapper._store.frames == [0, 3, 6, 18]
    drive.keyframes[1].part = 1
    drive.add(19, 31, TrackingStatus.ODOMETRY)
    assert drive.mapper._store.frames == [0, 3, 6, 18]


def test_map_without_corrections_is_not_rebuilt() -> None:
    drive = Drive(OccupancyMapper(CONFIG, CAMERA))
    drive.add(0, 30)
    before = drive.mapper.map.state_dict()
    drive.correct(shift=se3_exp(torch.tensor([0.01, 0, 0, 0, 0, 0], dtype=torch.float64)))  # less than half a voxel
    drive.mapper.correct(drive.poses)
    assert not is_rebuilding(drive.mapper) and torch.equal(drive.mapper.map.blocks.log_odds, before["log_odds"])


def test_depth_belongs_to_the_pose_at_its_time() -> None:
    """A camera that has moved by ``T_dc`` when the depth image is taken, also after a correction of the poses."""
    delayed, moved = Drive(OccupancyMapper(CONFIG, CAMERA)), Drive(OccupancyMapper(CONFIG, CAMERA))
    T_dc = se3_exp(torch.tensor([0.02, 0.0, 0.03, 0.0, 0.05, 0.0], dtype=torch.float64))
    delayed.add(0, 1, T_dc=T_dc)
    moved.keyframes[0].T_cw = T_dc @ moved.keyframes[0].T_cw
    moved.add(0, 1)
    assert same_map(delayed.mapper.map, moved.mapper.map)
    for drive in (delayed, moved):
        drive.correct()
        drive.mapper.correct(drive.poses)
    assert same_map(delayed.mapper.map, moved.mapper.map)


def test_corrected_map_equals_the_map_of_the_corrected_poses() -> None:
    drive, truth = Drive(OccupancyMapper(CONFIG, CAMERA)), Drive(OccupancyMapper(CONFIG, CAMERA))
    drive.add(0, 25)
    uncorrected = drive.mapper.map.occupied_points
    drive.correct()
    drive.mapper.correct(drive.poses)
    truth.correct()
    truth.add(0, 25)
    assert same_map(drive.mapper.map, truth.mapper.map)
    assert not torch.equal(drive.mapper.map.occupied_points, uncorrected)


def test_rebuild_is_spread_over_frames_and_ends_with_the_corrected_map() -> None:
    drive, truth = Drive(OccupancyMapper(CONFIG, CAMERA)), Drive(OccupancyMapper(CONFIG, CAMERA))
    drive.add(0, 29)
    drive.correct()
    occupancy, rebuilding = drive.mapper.map, []
    for index in range(29, 50):
        drive.add(index, index + 1)
        rebuilding.append(is_rebuilding(drive.mapper))
    assert rebuilding == [True] * 7 + [False] * 14  # 30 views, and one more with each frame, in steps of five
    assert drive.mapper.map is occupancy
    truth.correct()
    truth.add(0, 50)
    assert same_map(drive.mapper.map, truth.mapper.map)


def test_corrections_during_a_rebuild_do_not_delay_its_end() -> None:
    """A rebuild of 70 views takes longer than the time between two corrections, ten views."""
    drive = Drive(OccupancyMapper(CONFIG, CAMERA))
    drive.add(0, 60)
    uncorrected = drive.mapper.map.blocks
    for first in (60, 70, 80):
        drive.correct()
        drive.add(first, first + 10)
    assert drive.mapper.map.blocks is not uncorrected


def test_correction_during_a_rebuild_is_applied_afterwards() -> None:
    drive, truth = Drive(OccupancyMapper(CONFIG, CAMERA)), Drive(OccupancyMapper(CONFIG, CAMERA))
    drive.add(0, 29)
    drive.correct()
    drive.add(29, 32)
    assert is_rebuilding(drive.mapper)
    drive.correct()
    drive.mapper.correct(drive.poses)
    truth.correct()
    truth.correct()
    truth.add(0, 32)
    assert same_map(drive.mapper.map, truth.mapper.map)


def follow(
    mapper: OccupancyMapper, poses: PoseHistory, start: Keyframe, T_wc: Tensor, depth: Callable[[Tensor], Tensor]
) -> None:
    """Add frames at poses, (N, 4, 4), which are relative to one keyframe; `depth` renders the image of a pose."""
    for T in T_wc:
        pose = FramePose(TrackingStatus.TRACKED, invert(T) @ start.T_cw, torch.zeros(1).long())
        poses.append(len(poses) / 30, pose, MOTION, start, None)
        mapper(depth(T), ALL, poses)


def wall(_: Tensor) -> Tensor:
    """Depth image of a wall 2 m in front of the camera, metres, (1, H, W)."""
    return torch.full((1, CAMERA.height, CAMERA.width), 2.0)


def corridor(T_wc: Tensor) -> Tensor:
    """Depth image of a long corridor along z, which is 3.06 m wide, metres, (1, H, W)."""
    origin, direction = T_wc[:3, 3], CAMERA.rays.to(torch.float64) @ T_wc[:3, :3].T
    walls = (0, 1.53), (0, -1.53), (1, 1.23), (1, -1.33)
    sides = [(wall - origin[axis]) / direction[..., axis] for axis, wall in walls]
    return torch.stack([torch.where(depth > 0, depth, torch.inf) for depth in sides]).amin(dim=0)[None].float()


def test_places_of_removed_views_stay_in_the_map_after_a_correction() -> None:
    mapper = OccupancyMapper(CONFIG.model_copy(update={"max_views": 20}), CAMERA)
    along_wall = HERE.repeat(40, 1, 1)
    along_wall[:, 0, 3] = 0.6 * torch.arange(40)
    poses, start = PoseHistory(), keyframe(HERE)
    follow(mapper, poses, start, along_wall, wall)
    assert len(mapper._store) <= 20
    before = mapper.map.occupied_points[:, 0]
    start.T_cw = start.T_cw @ se3_exp(torch.tensor([0.0, 0.04, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    mapper.correct(poses)
    after = mapper.map.occupied_points[:, 0]
    assert float(before.max() - before.min()) > 24
    assert abs(float(after.min() - before.min())) < 0.1 and abs(float(after.max() - before.max())) < 0.1
    assert len(after.div(0.4).floor().unique()) == len(before.div(0.4).floor().unique())  # without gaps


def test_places_of_views_that_are_removed_during_a_rebuild_keep_its_correction() -> None:
    """The rebuild begins with the 20th view; the 21st removes the first three, which it contains already."""
    mapper = OccupancyMapper(CONFIG.model_copy(update={"max_views": 20}), CAMERA)
    along_wall = HERE.repeat(21, 1, 1)
    along_wall[:, 0, 3] = 0.6 * torch.arange(21)
    poses, start = PoseHistory(), keyframe(HERE)
    follow(mapper, poses, start, along_wall[:19], wall)
    start.T_cw = start.T_cw @ se3_exp(torch.tensor([0.0, 0.0, -0.4, 0.0, 0.0, 0.0], dtype=torch.float64))
    follow(mapper, poses, start, along_wall[19:], wall)
    assert is_rebuilding(mapper) and mapper._store.frames[0] == 3
    start.T_cw = start.T_cw @ se3_exp(torch.tensor([0.0, 0.04, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    mapper.correct(poses)
    x, _, z = mapper.map.occupied_points.T
    torch.testing.assert_close(z[x < 0.4], torch.full_like(z[x < 0.4], 2.4), atol=0.1, rtol=0)


def test_walls_that_the_remaining_views_hardly_see_stay_in_the_map_after_a_correction() -> None:
    mapper = OccupancyMapper(CONFIG.model_copy(update={"max_views": 45, "stride": 12}), CAMERA)
    twists = torch.zeros(130, 6, dtype=torch.float64)
    twists[:, 4] = torch.arange(130) % 9 * (2 * torch.pi / 9)
    along_corridor = se3_exp(twists)
    along_corridor[:, 2, 3] = 0.15 * torch.arange(130)
    poses, start = PoseHistory(), keyframe(HERE)
    follow(mapper, poses, start, along_corridor, corridor)
    before = mapper.map.occupied_points[:, 2]
    start.T_cw = start.T_cw @ se3_exp(torch.tensor([0.03, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    mapper.correct(poses)
    metres = [points.histc(bins=20, min=0, max=20) for points in (before, mapper.map.occupied_points[:, 2])]
    assert mapper._store.has_removed_far and (metres[1] > metres[0] / 2).all()


def test_number_of_stored_views_is_bounded_also_during_a_rebuild() -> None:
    drive = Drive(OccupancyMapper(CONFIG.model_copy(update={"max_views": 20}), CAMERA))
    drive.add(0, 38)
    drive.correct()
    for index in range(38, 90):
        drive.add(index, index + 1)
        assert len(drive.mapper._store) <= 20
    drive.mapper.correct(drive.poses)
    assert not is_rebuilding(drive.mapper) and drive.mapper._store.frames[-1] == 89


def test_rebuild_adds_each_stored_view_once_if_others_are_removed_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rebuild begins with the 30th view; the 34th is one too many."""
    mapper = OccupancyMapper(CONFIG.model_copy(update={"max_views": 33}), CAMERA)
    drive, integrate, added = Drive(mapper), mapper._integrate, list[RangeView]()

    def record(occupancy: OccupancyMap, position: int) -> None:
        if occupancy is not mapper.map:
            added.append(mapper._store.views[position])
        integrate(occupancy, position)

    monkeypatch.setattr(mapper, "_integrate", record)
    drive.add(0, 29)
    drive.correct()
    drive.add(29, 33)
    assert is_rebuilding(mapper) and len(mapper._store) == 33
    drive.add(33, 34)
    assert is_rebuilding(mapper) and len(mapper._store) < 33
    for _ in steps_until(lambda: not is_rebuilding(mapper), 100, "the map was rebuilt"):
        drive.add(len(drive.poses), len(drive.poses) + 1)
    assert [sum(each is view for each in added) for view in mapper._store.views] == [1] * len(mapper._store)


@pytest.mark.parametrize("stop", [12, 32])
def test_saved_state_continues_to_the_same_bytes(stop: int, tmp_path: Path) -> None:
    """Also in the middle of a rebuild."""
    drive = Drive(OccupancyMapper(CONFIG, CAMERA))
    drive.add(0, min(stop, 29))
    drive.correct()
    drive.add(min(stop, 29), stop)
    assert is_rebuilding(drive.mapper) == (stop == 32)
    write_state(tmp_path / "state", {}, drive.mapper.state_dict())
    resumed = Drive(OccupancyMapper(CONFIG, CAMERA))
    resumed.keyframes, resumed.poses = deepcopy((drive.keyframes, drive.poses))
    resumed.mapper.load_state_dict(read_state(tmp_path / "state", STATE_CLASSES)[1])
    for each in (drive, resumed):
        each.add(stop, 45)
        each.mapper.correct(each.poses)
    assert torch.equal(drive.mapper.map.blocks.log_odds, resumed.mapper.map.blocks.log_odds)
    assert torch.equal(drive.mapper.map.blocks.coordinates, resumed.mapper.map.blocks.coordinates)
    assert drive.mapper._store.frames == resumed.mapper._store.frames


def test_two_runs_give_the_same_bytes() -> None:
    first, second = Drive(OccupancyMapper(CONFIG, CAMERA)), Drive(OccupancyMapper(CONFIG, CAMERA))
    first.add(0, 12)
    second.add(0, 12)
    assert torch.equal(first.mapper.map.blocks.log_odds, second.mapper.map.blocks.log_odds)


def test_floor_and_grid_follow_the_up_direction() -> None:
    drive = Drive(OccupancyMapper(CONFIG, CAMERA))
    assert drive.mapper.find_floor() is None and drive.mapper.grid() is None
    drive.add(0, 11)
    drive.add(11, 12, up=estimate_up(gravity=torch.tensor([1.0, 0.0, 0.0])))
    drive.add(12, 13)  # nothing new is known
    floor = drive.mapper.find_floor()
    assert floor is not None and floor.up[0] < -0.99 and drive.mapper.grid() is not None


def test_floor_is_searched_again_when_the_number_of_views_has_doubled(monkeypatch: pytest.MonkeyPatch) -> None:
    drive, searched = Drive(OccupancyMapper(CONFIG, CAMERA)), []
    floors = iter([None, *(Floor(torch.eye(3, dtype=torch.float64)[k], 0.0, 1.0) for k in range(2)), None])

    def find_floor() -> Floor | None:
        searched.append(len(drive.poses))
        return next(floors)

    monkeypatch.setattr(drive.mapper, "find_floor", find_floor)
    found = []
    for index in range(70):
        drive.add(index, index + 1)
        found.append(None if drive.mapper.floor is None else int(drive.mapper.floor.up.argmax()))
    assert searched == [16, 32, 64] and found == [None] * 31 + [0] * 32 + [1] * 7
    drive.mapper.correct(drive.poses)  # finds none, and keeps the last one
    assert len(searched) == 4 and drive.mapper.floor is not None


def test_unknown_floor_is_searched_every_32_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """It becomes visible after 70 views."""
    drive, searched = Drive(OccupancyMapper(CONFIG.model_copy(update={"stride": 60}), CAMERA)), []
    floor = Floor(-torch.eye(3, dtype=torch.float64)[1], 0.0, 1.0)

    def find_floor() -> Floor | None:
        searched.append(len(drive.poses))
        return floor if len(drive.poses) > 70 else None

    monkeypatch.setattr(drive.mapper, "find_floor", find_floor)
    drive.add(0, 95)
    assert drive.mapper.floor is None
    drive.add(95, 170)
    assert drive.mapper.floor is floor and searched == [16, 32, 64, 96, 128]
