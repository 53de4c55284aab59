"""Pose history: lost frames, poses relative to keyframes, status."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers.moving_camera import EYE, TWIST, Camera, frame_pose, keyframe, twists, walk
from hypothesis import given, settings
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor
from torch.overrides import TorchFunctionMode

from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.types import TrackingStatus

TRACKED, ODOMETRY, LOST = TrackingStatus.TRACKED, TrackingStatus.ODOMETRY, TrackingStatus.LOST

# --- lost frames


def test_previous_velocity_is_unknown_after_a_jump_without_measured_motion() -> None:
    """A camera can be relocalised in the next frame, without having been lost in between."""
    camera, step = Camera(), se3_exp(0.1 * TWIST)
    T_cws = [EYE, step, step @ step, se3_exp(30 * TWIST), step @ se3_exp(30 * TWIST), step @ step @ se3_exp(30 * TWIST)]
    velocities = []
    for index, T_cw in enumerate(T_cws):
        camera.append(0.1 * index, frame_pose(T_cw), None, None if index in (0, 3) else step)
        velocities.append(camera.previous_velocity)
    assert velocities[0] is None and velocities[3] is None
    for known in (*velocities[1:3], *velocities[4:]):
        torch.testing.assert_close(known, TWIST, rtol=0, atol=1e-9)


def test_trajectory_without_frames_is_empty() -> None:
    trajectory = Camera().trajectory()
    assert len(trajectory) == 0 and trajectory.T_wc.shape == (0, 4, 4)


def test_lost_frames_are_interpolated_on_the_geodesic() -> None:
    stamps = [0.0, 0.1, 0.2, 0.35, 0.5, 0.6]  # unevenly spaced
    camera = walk(stamps, lost=(2, 3, 4))
    trajectory = camera.trajectory()
    expected = invert(se3_exp(TWIST * torch.tensor(stamps, dtype=torch.float64)[:, None]))
    torch.testing.assert_close(trajectory.T_wc, expected, rtol=0, atol=1e-9)
    assert [status.value for status in camera.poses.statuses] == ["tracked"] * 2 + ["lost"] * 3 + ["tracked"]


def test_interpolated_rotations_equal_scipy() -> None:
    stamps = [0.0, 0.2, 0.3, 1.0]
    ends = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-1.0, 0.8, 0.5]])
    camera = Camera()
    for index, stamp in enumerate(stamps):
        T_cw = EYE.clone()
        T_cw[:3, :3] = torch.from_numpy(ends[0 if index == 0 else 1].as_matrix())
        camera.append(stamp, frame_pose(T_cw, TrackingStatus.LOST if index in (1, 2) else TrackingStatus.TRACKED), None)
    R_cw = camera.trajectory().T_wc[:, :3, :3].mT.numpy()
    np.testing.assert_allclose(R_cw, Slerp([0.0, 1.0], ends)(stamps).as_matrix(), atol=1e-9)


def test_part_is_that_in_which_the_camera_was_last_found() -> None:
    camera, parts = Camera(), []
    start, other = keyframe(), keyframe(part=1)
    assert camera.poses.part == 0
    for index, (place, status, landmarks) in enumerate(
        [
            (start, TRACKED, (0, 1)),
            (other, LOST, ()),
            (other, TRACKED, (2,)),
            (start, ODOMETRY, ()),
            (start, TRACKED, (1,)),
        ]
    ):
        camera.append(0.1 * index, frame_pose(EYE, status, landmarks), place)
        parts.append(camera.poses.part)
    assert parts == [0, 0, 1, 1, 0]
    camera.append(0.5, frame_pose(EYE, TRACKED, (2,)), other)
    other.part = 0  # a loop joins the parts
    assert camera.poses.part == 0


def test_lost_frames_at_the_ends_keep_their_prediction() -> None:
    stamps = [k / 10 for k in range(6)]
    camera = walk(stamps, lost=(0, 4, 5))
    T_wc = camera.trajectory().T_wc
    torch.testing.assert_close(T_wc[0], T_wc[1], rtol=0, atol=1e-9)  # its motion was not measured
    torch.testing.assert_close(T_wc[4], invert(se3_exp(TWIST * 0.4)), rtol=0, atol=1e-9)
    torch.testing.assert_close(T_wc[5], camera.trajectory().T_wc[5])
    assert len(T_wc) == 6


def test_trajectory_of_a_camera_never_found_has_all_frames() -> None:
    trajectory = walk([0.0, 0.1, 0.2], lost=(0, 1, 2)).trajectory()
    assert trajectory.stamps.tolist() == [0.0, 0.1, 0.2]
    torch.testing.assert_close(trajectory.T_wc, EYE.expand(3, 4, 4))


# --- lost frames with measured motions


HIDDEN = se3_exp(torch.tensor([3.0, -1.0, 2.0, 0.5, 1.0, -0.7], dtype=torch.float64))
"""Pose of the first frame in the map, unknown until the camera is found."""
STEP = se3_exp(TWIST / 10)


def begin_lost(count: int, unknown: tuple[int, ...] = (), reference: Keyframe | None = None) -> Camera:
    """Lost frames of a camera in a guessed world frame; all motions are measured but the ``unknown`` ones."""
    camera = Camera()
    for index in range(count):
        T_cp = None if index == 0 or index in unknown else STEP
        T_cw = camera.predict(index / 10) if T_cp is None else T_cp @ camera.poses.T_cw
        assert camera.append(index / 10, frame_pose(T_cw, TrackingStatus.LOST), reference, T_cp) is None
    return camera


def true_pose(index: int) -> Tensor:
    """Pose ``T_cw`` of a frame in the map."""
    return torch.linalg.matrix_power(STEP, index) @ HIDDEN


def test_frames_before_the_first_found_one_follow_measured_motions() -> None:
    camera = begin_lost(5)
    assert not camera.poses.was_found
    found = keyframe(true_pose(5))
    T_new_old = camera.append(0.5, frame_pose(true_pose(5), landmarks=(1,)), found, STEP)
    assert camera.poses.was_found and T_new_old is not None
    torch.testing.assert_close(T_new_old, invert(HIDDEN), rtol=0, atol=1e-9)
    assert camera.poses.statuses == [*5 * [TrackingStatus.ODOMETRY], TrackingStatus.TRACKED]
    expected = invert(torch.stack([true_pose(index) for index in range(6)]))
    torch.testing.assert_close(camera.trajectory().T_wc, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(camera.predict(0.6), true_pose(6), rtol=0, atol=1e-9)  # velocity is kept
    # Corrections of the keyframe move all frames.
    found.T_cw = found.T_cw @ invert(STEP)
    torch.testing.assert_close(camera.trajectory().T_wc, STEP @ expected, rtol=0, atol=1e-9)


def test_frames_before_an_unmeasured_motion_stay_lost() -> None:
    """They are moved to the map by a guess, and keep the motions between them."""
    camera = begin_lost(8, unknown=(3,))
    camera.append(0.8, frame_pose(true_pose(8)), keyframe(true_pose(8)), STEP)
    assert camera.poses.statuses == [*3 * [TrackingStatus.LOST], *5 * [TrackingStatus.ODOMETRY], TrackingStatus.TRACKED]
    T_cw = invert(camera.trajectory().T_wc)
    expected = torch.stack([true_pose(index) for index in range(8)])
    torch.testing.assert_close(T_cw[3:8], expected[3:], rtol=0, atol=1e-9)
    torch.testing.assert_close(T_cw[1] @ invert(T_cw[0]), STEP, rtol=0, atol=1e-9)
    assert (invert(T_cw)[2, :3, 3] - invert(T_cw)[3, :3, 3]).norm() < 0.1


def test_lost_frames_linked_by_measured_motions_become_odometry() -> None:
    """The world is not corrected, and frames that no measured motion links are interpolated."""
    camera = Camera()
    own = keyframe(true_pose(0))
    for index in range(3):
        camera.append(index / 10, frame_pose(true_pose(index)), own, STEP)
    for index in range(3, 8):
        T_cp = None if index in (3, 5) else STEP
        T_cw = camera.poses.T_cw if T_cp is None else T_cp @ camera.poses.T_cw
        camera.append(index / 10, frame_pose(T_cw, TrackingStatus.LOST), own, T_cp)
    assert camera.append(0.8, frame_pose(true_pose(8)), own, STEP) is None
    assert camera.poses.statuses == [
        *3 * [TrackingStatus.TRACKED],
        *2 * [TrackingStatus.LOST],
        *3 * [TrackingStatus.ODOMETRY],
        TrackingStatus.TRACKED,
    ]
    expected = invert(torch.stack([true_pose(index) for index in range(9)]))
    torch.testing.assert_close(camera.trajectory().T_wc, expected, rtol=0, atol=1e-9)


def test_lost_frames_found_in_a_disconnected_part_are_disconnected() -> None:
    camera = begin_lost(3)
    camera.append(0.3, frame_pose(true_pose(3)), keyframe(true_pose(3), part=1), STEP)
    assert camera.poses.statuses == 4 * [TrackingStatus.DISCONNECTED]


@pytest.mark.parametrize(("part", "status"), [(0, ODOMETRY), (1, TrackingStatus.DISCONNECTED)])
def test_lost_frames_before_a_keyframe_of_a_lost_camera_belong_to_its_part(part: int, status: TrackingStatus) -> None:
    """The keyframe starts the map or another part; only the frames that measured motions link to it belong to it."""
    camera = begin_lost(4, unknown=(2,))
    before = invert(camera.trajectory().T_wc)
    own = keyframe(STEP @ before[3], part=part)
    reference = keyframe() if part else None
    assert camera.append(0.4, frame_pose(own.T_cw, LOST), reference, STEP, own) is None
    found = TRACKED if part == 0 else status
    assert camera.poses.statuses == [LOST, LOST, status, status, found]
    own.T_cw = own.T_cw @ invert(HIDDEN)  # a loop moves the part
    expected = torch.cat([before[2:] @ invert(HIDDEN), own.T_cw[None]])
    torch.testing.assert_close(camera.poses.poses_of([2, 3, 4]), expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(camera.poses.poses_of([0, 1]), before[:2], rtol=0, atol=1e-9)


# --- corrections of keyframes


@settings(max_examples=20)
@given(twists, twists)
def test_poses_follow_corrections_of_their_keyframe(at: Tensor, correction: Tensor) -> None:
    """The pose relative to the keyframe stays the same when the back end moves the keyframe."""
    reference = keyframe(se3_exp(at))
    camera = walk([0.0, 0.1, 0.2], reference=reference)
    before = camera.trajectory().T_wc
    reference.T_cw = se3_exp(correction) @ reference.T_cw
    after = camera.trajectory().T_wc
    T_new_old = invert(se3_exp(correction) @ se3_exp(at)) @ se3_exp(at)
    torch.testing.assert_close(after, T_new_old @ before, rtol=0, atol=1e-9)
    torch.testing.assert_close(camera.poses.T_cw, invert(after[-1]), rtol=0, atol=1e-9)


def test_each_pose_follows_its_own_keyframe() -> None:
    first, second = keyframe(), keyframe(se3_exp(TWIST))
    camera = Camera()
    for stamp, reference in ((0.0, first), (0.1, second)):
        camera.append(stamp, frame_pose(se3_exp(TWIST * stamp)), reference)
    second.T_cw = second.T_cw @ se3_exp(torch.tensor([-1.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    T_wc = camera.trajectory().T_wc
    assert torch.equal(T_wc[0], EYE)
    shift = T_wc[1] @ se3_exp(TWIST * 0.1)  # new from old
    torch.testing.assert_close(shift[:3, 3], torch.tensor([1.0, 0, 0], dtype=torch.float64), rtol=0, atol=1e-9)


def test_lost_frames_are_interpolated_after_corrections() -> None:
    reference = keyframe()
    camera = Camera()
    camera.append(0.0, frame_pose(EYE), None)
    camera.append(0.1, frame_pose(EYE, TrackingStatus.LOST), reference)
    camera.append(0.2, frame_pose(EYE), reference)
    reference.T_cw = se3_exp(torch.tensor([-0.4, 0, 0, 0, 0, 0], dtype=torch.float64))
    x = camera.trajectory().T_wc[:, 0, 3]
    assert x.tolist() == pytest.approx([0.0, 0.2, 0.4])


def test_pose_of_a_new_keyframe_is_that_of_the_keyframe() -> None:
    camera = walk([0.0], reference=keyframe())
    own = keyframe(se3_exp(TWIST), stamp=0.1, landmarks=7)
    camera.append(0.1, frame_pose(se3_exp(TWIST)), keyframe(), new=own)
    assert torch.equal(camera.poses.T_cw, own.T_cw)
    own.T_cw = se3_exp(2 * TWIST)
    assert torch.equal(camera.poses.T_cw, own.T_cw)
    assert camera.poses.observed_landmarks.tolist() == list(range(7))
    assert len(camera.poses.statuses) == 2


# --- status


def test_first_keyframe_of_a_lost_camera_is_tracked() -> None:
    camera = Camera()
    camera.append(0.0, frame_pose(EYE, TrackingStatus.LOST), None)
    assert camera.poses.status is TrackingStatus.LOST
    camera.append(0.1, frame_pose(EYE, TrackingStatus.LOST), None, new=keyframe())
    assert camera.poses.status is TrackingStatus.TRACKED


def test_frames_of_a_disconnected_keyframe_are_disconnected() -> None:
    camera = Camera()
    guess = keyframe(part=1)
    camera.append(0.0, frame_pose(EYE, TrackingStatus.LOST), keyframe(), new=guess)
    camera.append(0.1, frame_pose(EYE), guess)
    camera.append(0.2, frame_pose(EYE, TrackingStatus.ODOMETRY), guess)
    assert camera.poses.statuses == 3 * [TrackingStatus.DISCONNECTED]
    assert not camera.poses.is_localised and not camera.poses.localised.any()


def test_frames_of_a_part_that_a_loop_joins_with_the_rest_have_the_status_of_their_pose() -> None:
    camera = begin_lost(2)
    guess, other = keyframe(part=1), keyframe(part=2)
    camera.append(0.2, frame_pose(EYE, LOST), keyframe(), STEP, guess)
    camera.append(0.3, frame_pose(EYE), other, STEP)
    camera.append(0.4, frame_pose(EYE), guess, STEP)
    assert camera.poses.statuses == 5 * [TrackingStatus.DISCONNECTED]
    guess.part = 0
    odometry = TrackingStatus.ODOMETRY  # the lost frames before the part, which measured motions link to it
    assert camera.poses.statuses == [odometry, odometry, TRACKED, TrackingStatus.DISCONNECTED, TRACKED]
    assert camera.poses.status is TRACKED


def test_landmark_ids_are_those_of_the_last_found_frame() -> None:
    camera = Camera()
    camera.append(0.0, frame_pose(EYE, landmarks=(5, -1, 2)), None)
    camera.append(0.1, frame_pose(EYE, TrackingStatus.LOST, landmarks=(-1, -1)), None)
    assert camera.poses.observed_landmarks.tolist() == [5, 2]


def test_poses_of_chosen_frames_follow_their_keyframes() -> None:
    camera, own = Camera(), keyframe(true_pose(0))
    assert camera.poses.keyframe is None and camera.poses.poses_of([]).shape == (0, 4, 4)
    camera.append(0.0, frame_pose(true_pose(0)), None, None, own)
    for index in range(1, 6):
        camera.append(index / 10, frame_pose(true_pose(index)), own, STEP)
    assert camera.poses.keyframe is own
    frames = [5, 0, 3]
    expected = torch.stack([true_pose(index) for index in frames])
    torch.testing.assert_close(camera.poses.poses_of(frames), expected, rtol=0, atol=1e-9)
    own.T_cw = own.T_cw @ STEP
    moved = invert(camera.trajectory().T_wc)[frames]
    torch.testing.assert_close(camera.poses.poses_of(frames), moved, rtol=0, atol=1e-9)
    torch.testing.assert_close(moved, expected @ STEP, rtol=0, atol=1e-9)


class Calls(TorchFunctionMode):
    """Counts calls of functions of torch."""

    count = 0

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return function(*args, **(kwargs or {}))


def test_trajectory_is_computed_without_a_loop_over_frames() -> None:
    """A live camera waits while the trajectory of a long run is computed."""
    short, long = walk([0.1 * k for k in range(10)]), walk([0.1 * k for k in range(100)])
    calls = Calls(), Calls()
    for each, camera in zip(calls, (short, long), strict=True):
        with each:
            assert len(camera.trajectory()) == len(camera.poses)
    assert calls[0].count == calls[1].count > 0
