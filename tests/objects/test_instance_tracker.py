"""Ids of objects over frames, and objects that the network misses, on boards that move before a wall."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import lstsq
from torch import Tensor

from v3d_torch.config import CloudConfig, TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.objects.assignment import match_instances
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.objects.instance_tracker import InstanceTracker
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.objects.track import Track
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
CLOUDS = CloudConfig(stride=1)  # a quarter of the usual resolution
WALL = 4.0
HERE = torch.eye(4, dtype=torch.float64)
PERSON, CHAIR, DOG = 0, 56, 16


@dataclass(frozen=True)
class Board:
    """A board parallel to the image of the camera at the origin: centre and size in metres, in the world."""

    x: float
    z: float = 2.0
    y: float = 0.0
    width: float = 0.4
    height: float = 0.8
    label: int = PERSON
    seen: bool = True  # by the network; it stands there anyway


def photograph(boards: list[Board], T_wc: Tensor = HERE) -> tuple[Tensor, Instances]:
    """Depth (1, H, W) and the instances in the order of the boards; the camera may move but not turn."""
    o = T_wc[:3, 3]
    depth = torch.full((CAMERA.height, CAMERA.width), WALL - float(o[2]))
    owner = torch.full(depth.shape, -1)
    for i, board in enumerate(boards):
        z = board.z - float(o[2])
        point = CAMERA.rays.double() * z + o
        inside = (point[..., 0] - board.x).abs() <= board.width / 2
        inside &= ((point[..., 1] - board.y).abs() <= board.height / 2) & (depth > z)
        depth[inside], owner[inside] = z, i
    seen = [i for i, board in enumerate(boards) if board.seen and bool((owner == i).any())]
    if not seen:
        return depth[None], Instances.empty(CAMERA.height, CAMERA.width)
    labels = torch.tensor([boards[i].label for i in seen])
    return depth[None], Instances(
        torch.stack([owner == i for i in seen]), labels, torch.ones(len(seen)), torch.zeros(len(seen), 4)
    )


def turned(boards: list[Board], T_wc: Tensor) -> tuple[Tensor, Instances]:
    """As `photograph`, for a camera at the origin that has turned around the vertical."""
    direction = CAMERA.rays.double() @ T_wc[:3, :3].T  # of unit depth in the camera
    depth, owner = WALL / direction[..., 2], torch.full((CAMERA.height, CAMERA.width), -1)
    for i, board in enumerate(boards):
        point = direction * (board.z / direction[..., 2:])
        inside = ((point[..., 0] - board.x).abs() <= board.width / 2) & (point[..., 1].abs() <= board.height / 2)
        depth[inside], owner[inside] = (board.z / direction[..., 2])[inside], i
    masks = torch.stack([owner == i for i in range(len(boards))])
    labels = torch.tensor([board.label for board in boards])
    return depth.float()[None], Instances(masks, labels, torch.ones(len(boards)), torch.zeros(len(boards), 4))


class Watch:
    """A tracker that is shown one set of boards after another."""

    def __init__(self, rate: float = 30.0, **config: float) -> None:
        self.rate = rate
        self.frame = -1
        self.tracker = InstanceTracker(TrackerConfig(**config), CAMERA, CLOUDS.voxel_size)
        self._lift = InstanceBackProjector(CLOUDS, CAMERA)

    def __call__(self, *boards: Board, T_wc: Tensor = HERE, stamp: float | None = None) -> list[Track]:
        self.frame += 1
        stamp = self.frame / self.rate if stamp is None else stamp
        depth, instances = photograph(list(boards), T_wc)
        return self.tracker(stamp, instances, self._lift(depth, instances), depth, T_wc)


def meet(watch: Watch, *boards: Board) -> None:
    """Show boards in three frames."""
    for _ in range(3):
        watch(*boards)


def at(tracks: list[Track], board: Board) -> Track:
    """The track whose centroid is at the board's centre, of which there must be one."""
    place = torch.tensor([board.x, board.y, board.z], dtype=torch.float64)
    found = [track for track in tracks if not track.missed and float((track.newest.centroid - place).norm()) < 0.03]
    assert len(found) == 1
    return found[0]


def middle(mask: Tensor) -> Tensor:
    """Mean (column, row) of a mask."""
    return mask.nonzero().double().mean(dim=0).flip(0)


def test_first_objects_are_numbered_from_1_in_the_order_of_the_instances() -> None:
    boards = [Board(0.0), Board(-0.8), Board(0.7)]
    tracks = Watch()(*boards)
    assert [at(tracks, board).id for board in boards] == [1, 2, 3]


@pytest.mark.parametrize("rate", [5.0, 30.0])
def test_ids_are_kept_under_motion(rate: float) -> None:
    """1 m/s to the right, 1 m/s away, one that stands."""
    watch = Watch(rate)
    for frame in range(int(rate)):
        t = frame / rate
        boards = [Board(-0.5 + t), Board(-1.0, 2.0 + t, y=-0.3, height=0.5), Board(1.2, 2.5)]
        tracks = watch(*boards)
        assert [at(tracks, board).id for board in boards] == [1, 2, 3]
    assert [track.id for track in tracks] == [1, 2, 3]


def test_ids_are_kept_when_the_order_of_the_instances_changes() -> None:
    watch = Watch()
    boards = [Board(0.0), Board(-0.8), Board(0.7)]
    for order in ([0, 1, 2], [2, 0, 1], [1, 0, 2], [2, 1, 0]):
        tracks = watch(*(boards[i] for i in order))
        assert [at(tracks, board).id for board in boards] == [1, 2, 3]
        assert [track.id for track in tracks] == [1, 2, 3]


def test_ids_are_kept_while_the_class_flickers_and_the_class_is_the_most_frequent_one() -> None:
    watch = Watch()
    for label in (PERSON, DOG, PERSON, CHAIR, PERSON, DOG, PERSON):
        tracks = watch(Board(0.0, label=label), Board(0.7, label=CHAIR))
        assert at(tracks, Board(0.0)).id == 1
        assert at(tracks, Board(0.7)).id == 2
    assert tracks[0].label == PERSON
    assert tracks[0].labels == {PERSON: 4, DOG: 2, CHAIR: 1}


def test_class_decides_between_two_that_are_equally_far() -> None:
    """A dog and a chair, and the camera has not looked while they moved by the half of what lies between them."""
    watch = Watch(5.0)
    watch(Board(-0.4, label=DOG), Board(0.4, label=CHAIR))
    tracks = watch(Board(0.0, y=-0.45, label=CHAIR), Board(0.0, y=0.45, label=DOG))
    assert at(tracks, Board(0.0, y=-0.45)).label == CHAIR
    assert at(tracks, Board(0.0, y=-0.45)).id == 2
    assert at(tracks, Board(0.0, y=0.45)).id == 1


def test_mask_decides_between_two_that_are_about_equally_far() -> None:
    """One beside the old place, without overlap, and one 2 cm farther off, below, with half of it."""
    watch = Watch()
    watch(Board(0.0, width=0.2))
    beside, below = Board(0.17, width=0.2), Board(0.0, y=0.19, width=0.2)
    tracks = watch(beside, below)
    x, y = next(track for track in tracks if track.id == 1).newest.centroid[:2].tolist()
    assert abs(x) < 0.04
    assert abs(y - 0.19) < 0.04


@pytest.mark.parametrize("rate", [10.0, 30.0])
def test_ids_are_kept_when_two_cross_one_behind_the_other(rate: float) -> None:
    """Of one class, 1 m/s each way, 0.6 m apart in depth; the one behind is covered in between."""
    watch = Watch(rate)
    for frame in range(int(1.6 * rate) + 1):
        x = frame / rate - 0.8
        near, far = Board(x, 2.0), Board(-x, 2.6)
        tracks = watch(near, far)
        assert at(tracks, near).id == 1
    assert at(tracks, far).id == 2


def test_ids_are_kept_when_the_camera_moves_over_still_objects() -> None:
    """1.2 m/s at 5 frames a second: in the image the boards move by half of what lies between them a frame."""
    watch = Watch(5.0)
    boards = [Board(-0.6), Board(-0.1), Board(0.4)]
    for frame in range(4):
        T_wc = HERE.clone()
        T_wc[0, 3] = -0.36 + 0.24 * frame
        T_wc[2, 3] = -0.1 * frame
        tracks = watch(*boards, T_wc=T_wc)
        for i, board in enumerate(boards, start=1):
            found = [track for track in tracks if abs(float(track.newest.centroid[0]) - board.x) < 0.1]
            assert [track.id for track in found] == [i]


def test_something_new_beyond_the_gate_is_a_new_object() -> None:
    watch = Watch()
    watch(Board(-0.5))
    tracks = watch(Board(0.5))
    assert [(track.id, track.missed) for track in tracks] == [(1, True), (2, False)]


@pytest.mark.parametrize(("rate", "reach"), [(30.0, 0.1 + 1.5 / 30), (5.0, 0.1 + 1.5 / 5)])
def test_gate_is_a_jump_and_what_the_fastest_comes_by_in_the_time(rate: float, reach: float) -> None:
    """Boards so narrow that their masks do not overlap."""
    for step, kept in ((reach - 0.02, True), (reach + 0.02, False)):
        watch = Watch(rate, max_speed=1.5, max_jump=0.1)
        watch(Board(0.0, width=0.1))
        assert at(watch(Board(step, width=0.1)), Board(step)).id == (1 if kept else 2)


def test_another_class_continues_an_object_only_in_its_place() -> None:
    for step, kept in ((0.04, True), (0.5, False)):
        watch = Watch()
        watch(Board(0.0, label=CHAIR))
        assert at(watch(Board(step, label=DOG)), Board(step)).id == (1 if kept else 2)


def test_one_that_vanishes_as_another_appears_takes_no_id_from_a_third() -> None:
    """The second moves on by 0.35 m; the first is missed, and someone new stands far away."""
    watch = Watch(5.0)
    watch(Board(-0.4, 2.0), Board(0.4, 2.0))
    moved, new = Board(0.05, 2.0), Board(1.1, 3.2)
    tracks = watch(Board(-0.4, 2.0, seen=False), moved, new)
    assert at(tracks, moved).id == 2
    assert at(tracks, new).id == 3


def test_ids_in_a_row_do_not_move_up_when_one_end_is_missed_and_the_other_found() -> None:
    """Books on a shelf, 0.2 m apart: all in the middle stand in their own places."""
    watch = Watch()
    shelf = [Board(0.2 * i - 0.5, width=0.15, height=0.3, label=CHAIR) for i in range(6)]
    watch(*shelf[:5])
    tracks = watch(*shelf[1:])
    assert [at(tracks, book).id for book in shelf[1:]] == [2, 3, 4, 5, 6]


def test_velocity_of_a_steady_walk() -> None:
    watch = Watch()
    for frame in range(20):
        tracks = watch(Board(-0.5 + 0.03 * frame, 2.0 + 0.01 * frame))
    expected = torch.tensor([0.9, 0.0, 0.3], dtype=torch.float64)
    assert float((tracks[0].velocity - expected).norm()) < 0.2


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.floats(0.01, 0.5), st.floats(-0.3, 0.3), st.floats(0.02, 0.5)), min_size=1, max_size=8))
def test_motion_filter_is_the_least_squares_solution(steps: list[tuple[float, float, float]]) -> None:
    """Oracle: SciPy solves for the states of all times at once, each residual over its standard deviation."""
    config = TrackerConfig(max_speed=1e6, acceleration_noise=1.5)
    motion = ConstantVelocityKalmanFilter(config)
    stamp = 7.0
    motion.update(stamp, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 0.1)
    size = 2 * len(steps) + 2
    rows, right = [np.eye(size)[0] / 0.1, np.eye(size)[1]], [1.0 / 0.1, 0.0]  # the first place, the first velocity
    for k, (dt, error, sigma) in enumerate(steps):
        stamp += dt
        x = 1.0 + 0.8 * (stamp - 7.0) + error
        motion.update(stamp, torch.tensor([x, 2.0, 3.0], dtype=torch.float64), sigma)
        noise = 1.5**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        step = np.zeros((2, size))
        step[:, 2 * k : 2 * k + 4] = [[-1, -dt, 1, 0], [0, -1, 0, 1]]
        rows += [*np.linalg.inv(np.linalg.cholesky(noise)) @ step, np.eye(size)[2 * k + 2] / sigma]
        right += [0.0, 0.0, x / sigma]
    place, velocity = lstsq(np.stack(rows), np.array(right))[0][-2:]
    expected = torch.tensor([place + 0.2 * velocity, 2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(motion.predict(stamp + 0.2), expected, rtol=0.0, atol=1e-7)
    torch.testing.assert_close(motion.velocity, torch.tensor([velocity, 0.0, 0.0], dtype=torch.float64))


def test_nobody_is_faster_than_the_greatest_speed() -> None:
    motion = ConstantVelocityKalmanFilter(TrackerConfig(max_speed=2.0))
    for frame in range(10):
        motion.update(0.1 * frame, torch.tensor([0.9, 0.0, 1.2], dtype=torch.float64) * frame, 0.05)
    torch.testing.assert_close(motion.velocity, torch.tensor([1.2, 0.0, 1.6], dtype=torch.float64))


def test_a_partial_view_moves_the_prediction_less() -> None:
    """Of somebody who stands only the left half is seen, or a half of the size stands there: the same centroid."""
    half = Board(-0.1, width=0.2)
    grown, cut = Watch(10.0), Watch(10.0)
    for _ in range(5):
        cut(Board(0.0))
        grown(Board(0.0, width=0.2))
    (same,), (part,) = grown(half), cut(half)
    assert float(same.predict(0.5)[0]) < -0.05
    assert abs(float(part.predict(0.5)[0])) < 0.5 * abs(float(same.predict(0.5)[0]))
    assert abs(float(part.velocity[0])) < 0.5 * abs(float(same.velocity[0]))


def test_in_its_place_an_object_is_found_however_its_centroid_jumps() -> None:
    """All but the head was covered; nothing comes by half a metre in a frame, but the masks are in one place."""
    watch = Watch(max_jump=0.05, max_speed=0.3)
    watch(Board(0.0, y=-0.1, height=0.6))
    (track,) = watch(Board(0.0, y=0.04, height=0.8))
    assert track.id == 1
    assert (track.newest.centroid - track.detections[0].centroid).norm() > 0.05 + 0.3 / 30


def test_a_fast_walker_is_found_where_the_motion_has_carried_the_mask() -> None:
    """2 m/s at 5 frames a second: the next place overlaps the last by nothing, and the class has changed."""
    watch = Watch(5.0)
    for frame in range(5):
        watch(Board(-1.0 + 0.4 * frame, 2.5, width=0.3))
    (track,) = watch(Board(1.0, 2.5, width=0.3, label=DOG))
    assert track.id == 1


def test_a_camera_that_turns_keeps_ids_of_flickering_classes() -> None:
    """By 0.25 rad a frame: all masks move by more than their width."""
    watch = Watch(10.0)
    boards = [Board(-0.4, 3.0, width=0.3), Board(0.4, 3.0, width=0.3)]
    depth, instances = photograph(boards)
    lift = InstanceBackProjector(CLOUDS, CAMERA)
    watch.tracker(0.0, instances, lift(depth, instances), depth, HERE)
    T_wc = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, -0.25, 0.0], dtype=torch.float64))
    depth, instances = turned(boards, T_wc)
    instances = replace(instances, labels=torch.tensor([DOG, CHAIR]))
    tracks = watch.tracker(0.1, instances, lift(depth, instances), depth, T_wc)
    assert [(track.id, track.missed) for track in tracks] == [(1, False), (2, False)]


@pytest.mark.parametrize("there", [True, False])
def test_who_is_missed_but_seen_to_be_there_is_not_taken_for_who_appears_nearby(there: bool) -> None:
    """Within the gate and of its class; only where the place of the first is empty has the first moved there."""
    first, other = Board(-0.3), Board(0.28)
    watch = Watch()
    meet(watch, first)
    tracks = watch(*([replace(first, seen=False)] if there else []), other)
    assert at(tracks, other).id == (2 if there else 1)
    assert [track.id for track in tracks if track.missed] == ([1] if there else [])


def test_who_comes_into_sight_from_behind_something_is_the_part_that_was_seen() -> None:
    """First a part beside a cabinet, then all: the centroid jumps beyond the gate, but over the place of the part."""
    part, cabinet = Board(-0.9, width=0.4, height=2.0), Board(0.3, z=1.9, width=2.0, height=2.0, seen=False)
    whole = Board(0.1, width=2.4, height=2.0)
    watch = Watch()
    meet(watch, part, cabinet)
    assert [(track.id, track.missed) for track in watch(whole)] == [(1, False)]


def test_a_change_of_class_costs_what_decides_between_two_in_one_place() -> None:
    """Track 0 lies a little better on instance 1, but that is of the class of track 1."""
    nowhere = torch.full((1, 2, 3), torch.nan)
    overlap = torch.tensor([[[0.6, 0.7], [0.7, 0.6]]], dtype=torch.float64)
    gate = torch.ones(1, 2, dtype=torch.float64)
    alike = torch.eye(2, dtype=torch.bool)[None]
    assert match_instances(nowhere, nowhere, overlap, alike, gate, 0.5).tolist() == [[0, 1]]
    assert match_instances(nowhere, nowhere, overlap, alike | True, gate, 0.5).tolist() == [[1, 0]]


def test_a_far_centroid_costs_no_more_than_the_gate() -> None:
    """Masks in place and centroids five gates off, against a swap that saves less than one gate in all."""
    predicted = torch.tensor([[[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]], dtype=torch.float64)
    seen = torch.tensor([[[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    gate = torch.ones(1, 2, dtype=torch.float64)
    everything = torch.ones(1, 2, 2, dtype=torch.bool)
    overlap = torch.eye(2, dtype=torch.float64)[None] * 0.9
    matched = match_instances(predicted, seen, overlap, ~everything, gate, 0.5)
    assert matched.tolist() == [[0, 1]]


@pytest.mark.parametrize("rate", [5.0, 30.0])
def test_a_missed_object_is_predicted_with_its_mask_moved_along_and_then_forgotten(rate: float) -> None:
    watch = Watch(rate)
    step = 0.9 / rate
    frames = int(0.8 * rate)
    for frame in range(frames):
        watch(Board(-0.5 + step * frame, 2.0), Board(-1.4, 3.0, label=CHAIR))
    gap = 0
    while True:
        gap += 1
        hidden = Board(-0.5 + step * (frames + gap - 1), 2.0, seen=False)
        tracks = watch(hidden, Board(-1.4, 3.0, label=CHAIR))
        missed = [track for track in tracks if track.missed]
        if not missed:
            break
        assert [track.id for track in missed] == [1]
        truth = photograph([Board(hidden.x, 2.0)])[1].masks[0]
        predicted = missed[0].mask
        assert float((predicted & truth).sum()) / float(truth.sum()) > 0.9
        assert float((predicted & ~truth).sum()) / float(truth.sum()) < 0.3
        assert float((middle(predicted) - middle(truth)).abs().max()) < 2.0
    # Predicted for half a second, to the frame (the last one may fall on either side by rounding), then gone.
    assert gap - 1 in (int(0.5 * rate), int(0.5 * rate - 1e-9))
    assert [track.id for track in tracks] == [2]


def test_longest_gap_is_the_configured_one() -> None:
    watch = Watch(10.0, max_gap=0.25)
    watch(Board(0.0))
    present = [len(watch()) for _ in range(4)]
    assert present == [1, 1, 0, 0]


def test_a_walker_found_again_in_time_keeps_the_id() -> None:
    watch = Watch()
    for frame in range(40):
        missed = 20 <= frame < 32
        tracks = watch(Board(-0.6 + 0.03 * frame, seen=not missed))
        assert [(track.id, track.missed) for track in tracks] == [(1, missed)]


def test_one_found_again_too_late_gets_a_new_id_and_old_ids_never_come_back() -> None:
    watch = Watch(10.0)
    seen = set()
    for life in range(1, 5):
        for _ in range(2):
            (track,) = watch(Board(0.0))
            assert track.id == life
        assert track.id not in seen
        seen.add(track.id)
        for _ in range(6):
            tracks = watch()
        assert tracks == []


def test_a_predicted_mask_follows_the_camera() -> None:
    watch = Watch()
    meet(watch, Board(0.0))
    T_wc = HERE.clone()
    T_wc[0, 3] = 0.4
    (track,) = watch(Board(0.0, seen=False), T_wc=T_wc)
    truth = photograph([Board(0.0)], T_wc)[1].masks[0]
    assert track.missed
    assert float((middle(track.mask) - middle(truth)).abs().max()) < 1.5


def test_a_predicted_mask_leaves_out_what_stands_before_it_and_the_wall_behind_where_it_is_not() -> None:
    watch = Watch()
    meet(watch, Board(0.0, 3.0))
    post = Board(0.0, 1.5, width=0.05, height=2.0, seen=False)
    (track,) = watch(Board(0.0, 3.0, seen=False), post)
    depth, _ = photograph([Board(0.0, 3.0), post])
    assert int(track.mask.sum()) > 200
    assert float(depth[0][track.mask].min()) == 3.0
    assert float(depth[0][track.mask].max()) == 3.0


def test_a_predicted_mask_keeps_pixels_without_depth() -> None:
    """A walker's far shadow leaves holes, and they are the walker's as well."""
    watch = Watch()
    meet(watch, Board(0.0))
    depth, _ = photograph([Board(0.0)])
    mask = photograph([Board(0.0)])[1].masks[0]
    depth[0, :, 75:85] = 0.0
    nothing = Instances.empty(CAMERA.height, CAMERA.width)
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, nothing)
    (track,) = watch.tracker(3 / 30, nothing, clouds, depth, HERE)
    assert bool(track.mask[mask].all())


def test_a_predicted_mask_is_empty_behind_the_camera_and_beside_the_image() -> None:
    for xi in ([0.0, 0.0, 3.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.5, 0.0]):
        watch = Watch()
        meet(watch, Board(0.0))
        depth = torch.full((1, CAMERA.height, CAMERA.width), 2.0)
        nothing = Instances.empty(CAMERA.height, CAMERA.width)
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, nothing)
        (track,) = watch.tracker(3 / 30, nothing, clouds, depth, se3_exp(torch.tensor(xi, dtype=torch.float64)))
        assert track.missed
        assert int(track.mask.sum()) == 0


def test_without_a_centroid_the_masks_alone_decide() -> None:
    """A board too far for its depth: no cloud, and yet one object over time, two of them even."""
    watch = Watch()
    for frame in range(5):
        shift = 0.02 * frame
        far = [Board(-1.5 + shift, 7.0, width=1.2, height=2.0), Board(1.5 - shift, 7.0, width=1.2, height=2.0)]
        depth, _ = photograph([])
        masks = []
        for board in far:
            point = CAMERA.rays * 7.0
            masks.append(((point[..., 0] - board.x).abs() < 0.6) & (point[..., 1].abs() < 1.0))
            depth[0, masks[-1]] = 7.0
        instances = Instances(torch.stack(masks), torch.zeros(2, dtype=torch.int64), torch.ones(2), torch.zeros(2, 4))
        tracks = watch.tracker(
            frame / 30, instances, InstanceBackProjector(CLOUDS, CAMERA)(depth, instances), depth, HERE
        )
        assert [track.id for track in tracks] == [1, 2]
        assert not any(track.newest.located for track in tracks)
    assert not tracks[0].velocity.any()


def test_a_centroid_that_is_lost_for_a_frame_costs_neither_id_nor_velocity() -> None:
    watch = Watch()
    for frame in range(12):
        depth, instances = photograph([Board(-0.3 + 0.03 * frame)])
        if frame == 8:
            depth = torch.zeros_like(depth)
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        (track,) = watch.tracker(frame / 30, instances, clouds, depth, HERE)
        assert track.id == 1
        assert torch.isfinite(track.velocity).all()
    assert float(track.velocity[0]) == pytest.approx(0.9, abs=0.3)


def test_pair_looks_back_by_the_baseline_and_no_further_than_needed() -> None:
    watch = Watch()
    for frame in range(20):
        (track,) = watch(Board(-0.3 + 0.01 * frame))
        pairs = {baseline: track.detection_pair(baseline) for baseline in (0.0, 0.3)}
        assert (pairs[0.0] is None) is (frame < 1)
        assert (pairs[0.3] is None) is (frame < 9)
    for baseline, span in ((0.0, 1 / 30), (0.3, 0.3)):
        then, now = pairs[baseline] or (None, None)
        assert now is track.newest
        assert then is not None
        assert now.stamp - then.stamp == pytest.approx(span)


def test_pair_wants_both_centroids() -> None:
    watch = Watch()
    for blind in (False, True, False, False):
        watch.frame += 1
        depth, instances = photograph([Board(0.0)])
        depth = torch.zeros_like(depth) if blind else depth
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        (track,) = watch.tracker(watch.frame / 30, instances, clouds, depth, HERE)
        assert (track.pair(0.0) is not None) is (watch.frame == 3)


def test_memory_is_bounded_by_the_history() -> None:
    watch = Watch()
    for _ in range(60):
        (track,) = watch(Board(0.0))
    assert len(track.detections) == 31
    assert track.newest.stamp - track.detections[0].stamp == pytest.approx(1.0)
    assert track.first_seen == 0.0


@settings(max_examples=10, deadline=None)
@given(st.tuples(*[st.floats(-2.0, 2.0)] * 3, *[st.floats(-1.0, 1.0)] * 3))
def test_move_world_carries_all_of_a_track(xi: tuple[float, ...]) -> None:
    """After a correction of the map everything is as if the world had been the corrected one from the start."""
    T_new_old = se3_exp(torch.tensor(xi, dtype=torch.float64))
    corrected, always = Watch(), Watch()
    for frame in range(6):
        boards = [Board(-0.5 + 0.03 * frame), Board(0.8, 3.0)]
        T_wc = HERE.clone()
        T_wc[2, 3] = -0.02 * frame
        if frame == 4:
            corrected.tracker.move_world(T_new_old)
        depth, instances = photograph(boards, T_wc)
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        arguments = (frame / 30, instances, clouds, depth)
        old = corrected.tracker(*arguments, T_new_old @ T_wc if frame >= 4 else T_wc)
        new = always.tracker(*arguments, T_new_old @ T_wc)
    assert [track.id for track in old] == [track.id for track in new] == [1, 2]
    for a, b in zip(old, new, strict=True):
        torch.testing.assert_close(a.velocity, b.velocity, rtol=0.0, atol=1e-6)
        torch.testing.assert_close(a.predict(0.5), b.predict(0.5), rtol=0.0, atol=1e-6)
        for s, r in zip(a.sightings, b.sightings, strict=True):
            torch.testing.assert_close(s.centroid, r.centroid, rtol=0.0, atol=1e-6)
            torch.testing.assert_close(s.cloud, r.cloud, rtol=0.0, atol=1e-5)


def test_convention_sightings_are_in_the_world() -> None:
    """The camera stands at (0.5, 0, -1) and has turned by a quarter around the vertical: its z is the world's x."""
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    T_wc = HERE.clone()
    T_wc[:3, :3], T_wc[:3, 3] = turn, torch.tensor([0.5, 0.0, -1.0])
    depth, instances = photograph([Board(0.3, 2.0)])
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
    (track,) = Watch().tracker(0.0, instances, clouds, depth, T_wc)
    expected = torch.tensor([2.5, 0.0, -1.3], dtype=torch.float64)
    assert float((track.newest.centroid - expected).abs().max()) < 0.02
    torch.testing.assert_close(track.newest.cloud.double().mean(dim=0), track.newest.centroid, rtol=0.0, atol=1e-5)


def test_no_instances_ever() -> None:
    watch = Watch()
    assert [watch(), watch()] == [[], []]


def test_hundred_objects_in_any_order() -> None:
    """0.14 m wide, 0.2 m apart; they all move by 3 cm between the frames."""
    generator = torch.Generator().manual_seed(0)
    watch = Watch()
    places = [(0.22 * c - 1.0, 0.15 * r - 0.7) for r in range(10) for c in range(10)]
    for frame in range(3):
        boards = [Board(x + 0.03 * frame, 2.0, y, width=0.17, height=0.12) for x, y in places]
        order = torch.arange(100) if frame == 0 else torch.randperm(100, generator=generator)
        tracks = watch(*(boards[i] for i in order))
        assert [track.id for track in tracks] == list(range(1, 101))
        for i in (0, 37, 62, 99):
            assert at(tracks, boards[i]).id == i + 1


def test_equal_stamps_are_two_looks_at_one_place() -> None:
    watch = Watch()
    for frame in range(10):
        watch(Board(0.03 * frame), stamp=0.03 * frame)
        (track,) = watch(Board(0.03 * frame), stamp=0.03 * frame)
    assert track.id == 1
    assert float((track.velocity - torch.tensor([1.0, 0.0, 0.0])).norm()) < 0.2
    assert float(track.predict(0.27)[0]) == pytest.approx(0.27, abs=0.03)


def test_the_result_of_a_frame_is_not_changed_by_the_next_one() -> None:
    watch = Watch()
    first = watch(Board(0.0))
    watch(Board(0.0), Board(0.8))
    assert [track.id for track in first] == [1]
