"""Poses of frames: prediction, lost frames, and how they follow their keyframes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import FramePose, TrackingStatus

EYE = torch.eye(4, dtype=torch.float64)
TWIST = torch.tensor([0.3, -0.1, 0.2, 0.1, 0.4, -0.3], dtype=torch.float64)  # m/s and rad/s

twists = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(lambda v: torch.tensor(v, dtype=torch.float64))


def keyframe(T_cw: Tensor = EYE, stamp: float = 0.0, landmarks: int = 0, disconnected: bool = False) -> Keyframe:
    none = torch.zeros(0, dtype=torch.int64)
    empty = Features(torch.zeros(0, 2), torch.zeros(0, 2).long(), none.double(), none, torch.zeros(0, 32).byte())
    return Keyframe(0, 0, stamp, T_cw, empty, torch.arange(landmarks), disconnected)


def estimate(
    T_cw: Tensor, status: TrackingStatus = TrackingStatus.TRACKED, landmarks: tuple[int, ...] = ()
) -> FramePose:
    return FramePose(status, T_cw, torch.tensor(landmarks, dtype=torch.int64))


def walk(stamps: list[float], lost: tuple[int, ...] = (), tied_to: Keyframe | None = None) -> PoseHistory:
    """Frames of a camera that moves with the constant twist; lost ones are recorded where they are predicted."""
    poses = PoseHistory()
    for index, stamp in enumerate(stamps):
        if index in lost:
            poses.record(stamp, estimate(poses.predict(stamp), TrackingStatus.LOST), tied_to)
        else:
            poses.record(stamp, estimate(se3_exp(TWIST * stamp)), tied_to)
    return poses


# --- prediction


def test_nothing_is_known_before_the_first_frame() -> None:
    poses = PoseHistory()
    assert poses.status is None and poses.statuses == []
    assert torch.equal(poses.T_cw, EYE)
    assert torch.equal(poses.predict(3.0), EYE)


@settings(deadline=None, max_examples=30)
@given(twists, st.floats(0.01, 0.1), st.floats(0.01, 0.2))
def test_constant_velocity_is_predicted_exactly(twist: Tensor, step: float, ahead: float) -> None:
    poses = PoseHistory()
    for stamp in (0.0, step):
        poses.record(stamp, estimate(se3_exp(twist * stamp)), None)
    torch.testing.assert_close(poses.predict(step + ahead), se3_exp(twist * (step + ahead)), rtol=0, atol=1e-9)


def test_convention_velocity_acts_in_the_camera_frame() -> None:
    """A camera far from the origin that turns on the spot is predicted to stay there."""
    T_wc = EYE.clone()
    T_wc[:3, 3] = torch.tensor([10.0, -5.0, 3.0])
    turn = torch.tensor([0, 0, 0, 0, 0.5, 0], dtype=torch.float64)
    poses = PoseHistory()
    for stamp in (0.0, 0.1):
        poses.record(stamp, estimate(invert(T_wc @ se3_exp(turn * stamp))), None)
    predicted = invert(poses.predict(0.2))
    torch.testing.assert_close(predicted[:3, 3], T_wc[:3, 3], rtol=0, atol=1e-9)
    torch.testing.assert_close(predicted, T_wc @ se3_exp(turn * 0.2), rtol=0, atol=1e-9)


def test_no_motion_is_believed_for_longer_than_a_fifth_of_a_second() -> None:
    poses = walk([0.0, 0.1])
    torch.testing.assert_close(poses.predict(5.0), se3_exp(TWIST * 0.3), rtol=0, atol=1e-9)


def test_a_lost_camera_goes_on_for_a_moment_and_then_stands() -> None:
    stamps = [k / 30 for k in range(40)]
    poses = walk(stamps[:10])
    where = []
    for stamp in stamps[10:]:
        where.append(invert(poses.predict(stamp))[:3, 3])
        poses.record(stamp, estimate(poses.predict(stamp), TrackingStatus.LOST), None)
    steps = torch.stack(where).diff(dim=0).norm(dim=1)
    speed = float(TWIST[:3].norm())
    assert steps[:4].min() > 0.9 * speed / 30  # goes on
    assert (steps[8:] < 1e-12).all()  # stands
    assert steps.sum() < 0.3 * speed


def test_a_lost_camera_whose_motions_are_known_goes_on_as_they_tell() -> None:
    """Images are unrolled by the velocity: with none, each pair of them would be bent unalike."""
    poses, step = walk([0.0, 0.1]), se3_exp(-0.1 * TWIST)
    for k in range(2, 20):
        poses.record(0.1 * k, estimate(step @ poses.T_cw, TrackingStatus.LOST), None, step)
        torch.testing.assert_close(poses.outlook().velocity, -TWIST, rtol=0, atol=1e-9)


def test_the_jump_to_where_a_lost_camera_is_found_is_no_velocity() -> None:
    poses = walk([0.0, 1 / 30], lost=())
    for k in range(2, 20):
        poses.record(k / 30, estimate(poses.T_cw, TrackingStatus.LOST), None)
    away = se3_exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    poses.record(20 / 30, estimate(away), None)
    torch.testing.assert_close(poses.predict(21 / 30), away, rtol=0, atol=1e-12)


# --- lost frames


def test_a_jump_to_a_place_seen_before_is_no_motion_that_a_frame_was_passed_with() -> None:
    """A camera may be found elsewhere at once, without having been lost: no motion joins the two frames."""
    poses, step = PoseHistory(), se3_exp(0.1 * TWIST)
    there = [EYE, step, step @ step, se3_exp(30 * TWIST), step @ se3_exp(30 * TWIST), step @ step @ se3_exp(30 * TWIST)]
    passed = []
    for index, T_cw in enumerate(there):
        poses.record(0.1 * index, estimate(T_cw), None, None if index in (0, 3) else step)
        passed.append(poses.passed)
    assert passed[0] is None and passed[3] is None
    for known in (*passed[1:3], *passed[4:]):
        torch.testing.assert_close(known, TWIST, rtol=0, atol=1e-9)


def test_without_frames_the_trajectory_is_empty() -> None:
    trajectory = PoseHistory().trajectory()
    assert len(trajectory) == 0 and trajectory.T_wc.shape == (0, 4, 4)


def test_lost_frames_lie_on_the_geodesic_between_their_neighbours() -> None:
    stamps = [0.0, 0.1, 0.2, 0.35, 0.5, 0.6]  # unevenly spaced
    poses = walk(stamps, lost=(2, 3, 4))
    trajectory = poses.trajectory()
    expected = invert(se3_exp(TWIST * torch.tensor(stamps, dtype=torch.float64)[:, None]))
    torch.testing.assert_close(trajectory.T_wc, expected, rtol=0, atol=1e-9)
    assert [status.value for status in poses.statuses] == ["tracked"] * 2 + ["lost"] * 3 + ["tracked"]


def test_interpolated_rotations_equal_scipys() -> None:
    stamps = [0.0, 0.2, 0.3, 1.0]
    ends = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-1.0, 0.8, 0.5]])
    poses = PoseHistory()
    for index, stamp in enumerate(stamps):
        T_cw = EYE.clone()
        T_cw[:3, :3] = torch.from_numpy(ends[0 if index == 0 else 1].as_matrix())
        poses.record(stamp, estimate(T_cw, TrackingStatus.LOST if index in (1, 2) else TrackingStatus.TRACKED), None)
    R_cw = poses.trajectory().T_wc[:, :3, :3].mT.numpy()
    np.testing.assert_allclose(R_cw, Slerp([0.0, 1.0], ends)(stamps).as_matrix(), atol=1e-9)


def test_lost_frames_at_the_ends_stay_where_they_were_predicted() -> None:
    stamps = [k / 10 for k in range(6)]
    poses = walk(stamps, lost=(0, 4, 5))
    T_wc = poses.trajectory().T_wc
    torch.testing.assert_close(T_wc[0], T_wc[1], rtol=0, atol=1e-9)  # of which no motion was known
    torch.testing.assert_close(T_wc[4], invert(se3_exp(TWIST * 0.4)), rtol=0, atol=1e-9)
    torch.testing.assert_close(T_wc[5], poses.trajectory().T_wc[5])
    assert len(T_wc) == 6


def test_a_camera_that_is_never_found_still_has_a_pose_for_every_frame() -> None:
    trajectory = walk([0.0, 0.1, 0.2], lost=(0, 1, 2)).trajectory()
    assert trajectory.stamps.tolist() == [0.0, 0.1, 0.2]
    torch.testing.assert_close(trajectory.T_wc, EYE.expand(3, 4, 4))


# --- lost frames whose motions are known


HIDDEN = se3_exp(torch.tensor([3.0, -1.0, 2.0, 0.5, 1.0, -0.7], dtype=torch.float64))
"""Where the world is that a camera does not know at first."""
STEP = se3_exp(TWIST / 10)


def begin_lost(count: int, unknown: tuple[int, ...] = (), tied_to: Keyframe | None = None) -> PoseHistory:
    """Lost frames of a camera whose motions are known but for some, in a world of its own."""
    poses = PoseHistory()
    for index in range(count):
        T_cp = None if index == 0 or index in unknown else STEP
        T_cw = poses.predict(index / 10) if T_cp is None else T_cp @ poses.T_cw
        assert poses.record(index / 10, estimate(T_cw, TrackingStatus.LOST), tied_to, T_cp) is None
    return poses


def true_pose(index: int) -> Tensor:
    """``T_cw`` in the world that is found."""
    return torch.linalg.matrix_power(STEP, index) @ HIDDEN


def test_frames_before_the_first_that_is_found_are_put_where_their_motions_say() -> None:
    poses = begin_lost(5)
    assert not poses.located
    found = keyframe(true_pose(5))
    T_new_old = poses.record(0.5, estimate(true_pose(5), landmarks=(1,)), found, STEP)
    assert poses.located and T_new_old is not None
    torch.testing.assert_close(T_new_old, invert(HIDDEN), rtol=0, atol=1e-9)
    assert poses.statuses == [*5 * [TrackingStatus.ODOMETRY], TrackingStatus.TRACKED]
    expected = invert(torch.stack([true_pose(index) for index in range(6)]))
    torch.testing.assert_close(poses.trajectory().T_wc, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(poses.predict(0.6), true_pose(6), rtol=0, atol=1e-9)  # at the speed it had
    # From now on they follow the keyframe that the camera was found by.
    found.T_cw = found.T_cw @ invert(STEP)
    torch.testing.assert_close(poses.trajectory().T_wc, STEP @ expected, rtol=0, atol=1e-9)


def test_before_a_motion_that_is_not_known_frames_stay_lost() -> None:
    """Where they are is a guess then, but in the world that was found, and they keep their motions among each other."""
    poses = begin_lost(8, unknown=(3,))
    poses.record(0.8, estimate(true_pose(8)), keyframe(true_pose(8)), STEP)
    assert poses.statuses == [*3 * [TrackingStatus.LOST], *5 * [TrackingStatus.ODOMETRY], TrackingStatus.TRACKED]
    T_cw = invert(poses.trajectory().T_wc)
    expected = torch.stack([true_pose(index) for index in range(8)])
    torch.testing.assert_close(T_cw[3:8], expected[3:], rtol=0, atol=1e-9)
    torch.testing.assert_close(T_cw[1] @ invert(T_cw[0]), STEP, rtol=0, atol=1e-9)
    assert (invert(T_cw)[2, :3, 3] - invert(T_cw)[3, :3, 3]).norm() < 0.1


def test_a_camera_lost_on_the_way_comes_back_by_its_motions() -> None:
    """The world is not moved then, and what no motion joins to the frame that is found is interpolated."""
    poses = PoseHistory()
    own = keyframe(true_pose(0))
    for index in range(3):
        poses.record(index / 10, estimate(true_pose(index)), own, STEP)
    for index in range(3, 8):
        T_cp = None if index in (3, 5) else STEP
        T_cw = poses.T_cw if T_cp is None else T_cp @ poses.T_cw
        poses.record(index / 10, estimate(T_cw, TrackingStatus.LOST), own, T_cp)
    assert poses.record(0.8, estimate(true_pose(8)), own, STEP) is None
    assert poses.statuses == [
        *3 * [TrackingStatus.TRACKED],
        *2 * [TrackingStatus.LOST],
        *3 * [TrackingStatus.ODOMETRY],
        TrackingStatus.TRACKED,
    ]
    expected = invert(torch.stack([true_pose(index) for index in range(9)]))
    torch.testing.assert_close(poses.trajectory().T_wc, expected, rtol=0, atol=1e-9)


def test_found_in_a_part_disconnected_they_are_disconnected() -> None:
    poses = begin_lost(3)
    poses.record(0.3, estimate(true_pose(3)), keyframe(true_pose(3), disconnected=True), STEP)
    assert poses.statuses == 4 * [TrackingStatus.DISCONNECTED]


# --- keyframes move


@settings(deadline=None, max_examples=20)
@given(twists, twists)
def test_frames_follow_their_keyframe(at: Tensor, correction: Tensor) -> None:
    """What a frame sees of its keyframe stays the same when the back end moves the keyframe."""
    tied = keyframe(se3_exp(at))
    poses = walk([0.0, 0.1, 0.2], tied_to=tied)
    before = poses.trajectory().T_wc
    tied.T_cw = se3_exp(correction) @ tied.T_cw
    after = poses.trajectory().T_wc
    T_new_old = invert(se3_exp(correction) @ se3_exp(at)) @ se3_exp(at)
    torch.testing.assert_close(after, T_new_old @ before, rtol=0, atol=1e-9)
    torch.testing.assert_close(poses.T_cw, invert(after[-1]), rtol=0, atol=1e-9)


def test_each_frame_follows_its_own_keyframe() -> None:
    first, second = keyframe(), keyframe(se3_exp(TWIST))
    poses = PoseHistory()
    for stamp, tied in ((0.0, first), (0.1, second)):
        poses.record(stamp, estimate(se3_exp(TWIST * stamp)), tied)
    second.T_cw = second.T_cw @ se3_exp(torch.tensor([-1.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    T_wc = poses.trajectory().T_wc
    assert torch.equal(T_wc[0], EYE)
    shift = T_wc[1] @ se3_exp(TWIST * 0.1)  # new from old
    torch.testing.assert_close(shift[:3, 3], torch.tensor([1.0, 0, 0], dtype=torch.float64), rtol=0, atol=1e-9)


def test_lost_frames_are_interpolated_after_all_corrections() -> None:
    tied = keyframe()
    poses = PoseHistory()
    poses.record(0.0, estimate(EYE), None)
    poses.record(0.1, estimate(EYE, TrackingStatus.LOST), tied)
    poses.record(0.2, estimate(EYE), tied)
    tied.T_cw = se3_exp(torch.tensor([-0.4, 0, 0, 0, 0, 0], dtype=torch.float64))
    x = poses.trajectory().T_wc[:, 0, 3]
    assert x.tolist() == pytest.approx([0.0, 0.2, 0.4])


def test_a_frame_that_becomes_a_keyframe_is_the_keyframe() -> None:
    poses = walk([0.0, 0.1], tied_to=keyframe())
    own = keyframe(se3_exp(TWIST), stamp=0.1, landmarks=7)
    poses.anchor(own)
    assert torch.equal(poses.T_cw, own.T_cw)
    own.T_cw = se3_exp(2 * TWIST)
    assert torch.equal(poses.T_cw, own.T_cw)
    assert poses.landmarks.tolist() == list(range(7))
    assert len(poses.statuses) == 2


# --- status


def test_the_first_keyframe_makes_its_frame_tracked() -> None:
    poses = PoseHistory()
    poses.record(0.0, estimate(EYE, TrackingStatus.LOST), None)
    assert poses.status is TrackingStatus.LOST
    poses.anchor(keyframe())
    assert poses.status is TrackingStatus.TRACKED


def test_what_is_tied_to_a_guess_is_disconnected() -> None:
    poses = PoseHistory()
    poses.record(0.0, estimate(EYE, TrackingStatus.LOST), keyframe())
    guess = keyframe(disconnected=True)
    poses.anchor(guess)
    poses.record(0.1, estimate(EYE), guess)
    poses.record(0.2, estimate(EYE, TrackingStatus.ODOMETRY), guess)
    assert poses.statuses == [TrackingStatus.DISCONNECTED, TrackingStatus.DISCONNECTED, TrackingStatus.ODOMETRY]


def test_landmarks_are_those_of_the_last_frame_that_found_any() -> None:
    poses = PoseHistory()
    poses.record(0.0, estimate(EYE, landmarks=(5, -1, 2)), None)
    poses.record(0.1, estimate(EYE, TrackingStatus.LOST, landmarks=(-1, -1)), None)
    assert poses.landmarks.tolist() == [5, 2]
