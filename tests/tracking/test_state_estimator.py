"""State of the camera: twist and covariances while it is tracked, lost, found again, and in another part of the map."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.moving_camera import EYE, TWIST, frame_pose, keyframe
from torch import Tensor

from v3d_torch.geometry.se3 import adjoint, invert, se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.tracking.state_estimator import StateEstimator
from v3d_torch.types import FramePose, TrackingStatus

INFORMATION = 1e6 * torch.eye(6, dtype=torch.float64)
REST = torch.zeros(6, dtype=torch.float64)
CORRECTION = se3_exp(torch.tensor([2.0, -1.0, 3.0, 0.5, 1.2, -0.7], dtype=torch.float64))


class SteadyCamera:
    """Estimates the states of a camera at 30 Hz whose measured motions are those of a constant twist."""

    def __init__(self, twist: Tensor = REST) -> None:
        self._twist, self._poses = twist, PoseHistory()
        self.estimate = StateEstimator()

    def __call__(
        self,
        pose: FramePose,
        *,
        is_measured: bool = True,
        start: float = 0.0,
        owners: tuple[int, ...] = (),
        reference: Keyframe | None = None,
        new: Keyframe | None = None,
        keyframes: int = 1,
    ) -> CameraState:
        """Estimate the state at the next frame.

        Args:
            pose: Pose of the frame.
            is_measured: Whether its motion is measured.
            start: Time of the first frame.
            owners: Keyframes that created the landmarks of the frame.
            reference: Reference keyframe of the frame.
            new: Keyframe created from the frame.
            keyframes: Number of keyframes with the new one.
        """
        pairs = torch.zeros(0, 2, dtype=torch.int64)
        motion = CameraMotion(se3_exp(-self._twist / 30), -self._twist, pairs, is_measured)
        self._poses.append(start + len(self._poses) / 30, pose, motion, reference, new)
        references = None if new is None else torch.arange(keyframes)
        return self.estimate(pose, motion, self._poses, torch.tensor(owners, dtype=torch.int64), references)


def tracked(T_cw: Tensor = EYE) -> FramePose:
    return replace(frame_pose(T_cw, landmarks=(0,)), information=INFORMATION)


def test_jump_of_a_camera_that_is_found_again_is_not_a_twist() -> None:
    away = se3_exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    for status in (TrackingStatus.LOST, TrackingStatus.ODOMETRY):
        camera = SteadyCamera()
        for _ in range(10):
            camera(tracked())
        for _ in range(15):
            camera(frame_pose(EYE, status))
        for state in (camera(replace(tracked(away), is_relocalised=True)), camera(tracked(away))):
            assert state.twist.norm() < 0.01


def test_jump_of_a_camera_that_is_found_again_at_once_is_no_noise() -> None:
    """The frame after the jump is relocalised, so that no frame between them has a pose from its motion."""
    camera, away = SteadyCamera(), se3_exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    for _ in range(10):
        before = camera(tracked()).covariance
    camera(replace(tracked(away), is_relocalised=True), is_measured=False)
    for _ in range(10):
        after = camera(tracked(away)).covariance
    assert (after.diagonal() <= before.diagonal()).all()


def test_covariance_of_a_camera_not_yet_found_is_that_of_an_unknown_pose_at_any_time() -> None:
    camera, start = SteadyCamera(), 1.3e9
    state = camera(frame_pose(EYE, TrackingStatus.LOST), is_measured=False, start=start)
    expected = torch.tensor([100.0] * 3 + [torch.pi] * 3, dtype=torch.float64)
    torch.testing.assert_close(state.covariance, expected.square().diag())
    assert torch.equal(state.twist_covariance.diagonal().sqrt(), torch.tensor([1.0] * 3 + [2.0] * 3).double())
    for is_measured in (True, False):
        state = camera(frame_pose(EYE, TrackingStatus.LOST), is_measured=is_measured, start=start)
        torch.testing.assert_close(state.covariance.diagonal().sqrt(), expected, rtol=0.01, atol=0)


def test_covariance_grows_while_a_camera_is_not_found_where_its_measured_motion_leads() -> None:
    """The camera jumped to another place: its frame-to-frame motion is measured there, its pose is only a guess."""
    camera = SteadyCamera()
    for _ in range(10):
        state = camera(tracked())
    before = state.covariance.diagonal().sqrt()
    camera(frame_pose(EYE, TrackingStatus.LOST), is_measured=False)
    for _ in range(29):
        state = camera(frame_pose(EYE, TrackingStatus.LOST))
    assert before.max() < 0.05
    torch.testing.assert_close(state.covariance.diagonal().sqrt(), torch.ones(6).double(), rtol=0.1, atol=0)
    state = camera(replace(tracked(), is_relocalised=True))
    assert state.covariance.diagonal().sqrt().max() < 0.05


def test_correction_of_the_world_is_not_a_twist() -> None:
    camera = SteadyCamera(TWIST)
    for n in range(10):
        camera(tracked(se3_exp(-TWIST * n / 30)))
    camera.estimate.apply_world_correction(CORRECTION)
    for n in range(10, 13):
        state = camera(tracked(se3_exp(-TWIST * n / 30) @ invert(CORRECTION)))
        torch.testing.assert_close(state.twist, TWIST)


def test_moving_camera_that_is_found_again_has_its_measured_twist() -> None:
    camera = SteadyCamera(TWIST)
    camera(tracked())
    camera(frame_pose(EYE, TrackingStatus.LOST))
    state = camera(replace(tracked(), is_relocalised=True))
    torch.testing.assert_close(state.twist, TWIST)


@pytest.mark.parametrize("T_new_old", [EYE, CORRECTION], ids=["same_world", "corrected_world"])
def test_covariance_in_a_disconnected_part_contains_that_of_its_first_keyframe(T_new_old: Tensor) -> None:
    camera = SteadyCamera()
    camera(tracked())
    for _ in range(15):
        camera(frame_pose(EYE, TrackingStatus.LOST))
    start = se3_exp(torch.tensor([1.0, 2.0, 0.5, 0.3, -0.8, 0.2], dtype=torch.float64))
    first = keyframe(start, part=1)
    guessed = camera(frame_pose(start, TrackingStatus.LOST), new=first)
    assert guessed.covariance.diagonal().sqrt().min() > 0.5
    camera.estimate.apply_world_correction(T_new_old)
    T_ck = se3_exp(torch.tensor([0.5, -1.0, 2.0, 0.0, 1.0, 0.0], dtype=torch.float64))
    first.T_cw = start @ invert(T_new_old)
    state = camera(tracked(T_ck @ first.T_cw), reference=first)
    assert state.status is TrackingStatus.DISCONNECTED
    propagated = adjoint(T_ck) @ guessed.covariance @ adjoint(T_ck).T
    torch.testing.assert_close(state.covariance, propagated, rtol=0, atol=1e-3)  # the noise of a frame is added
    assert torch.linalg.eigvalsh(state.covariance - propagated).min() > 0


def test_frame_inherits_the_variance_of_all_frames_of_odometry_before_a_keyframe() -> None:
    """In units of the variance of a frame: the first keyframe has 1, the second 3; the frame adds its own 1."""
    camera = SteadyCamera()
    camera(frame_pose(EYE), new=keyframe())
    for _ in range(2):
        camera(frame_pose(EYE, TrackingStatus.ODOMETRY))
    camera(frame_pose(EYE, TrackingStatus.ODOMETRY), new=keyframe(), keyframes=2)
    with_first, with_second = (camera(tracked(), owners=(owner,)).covariance for owner in (0, 1))
    torch.testing.assert_close(with_second / (1 + 3), with_first / (1 + 1))


@pytest.mark.parametrize("gap", [1.0, 3.0, 4.0, 5.0])
def test_twist_after_a_gap_is_that_of_the_camera(gap: float) -> None:
    """The camera turned by 1 rad/s before the gap, and stands still in it and afterwards."""
    rate = torch.tensor([0.0, 0, 0, 0, 1.0, 0], dtype=torch.float64)
    camera, poses, no_matches = StateEstimator(), PoseHistory(), torch.zeros(0, 2, dtype=torch.int64)
    ids = torch.zeros(0, dtype=torch.int64)
    for n in range(30):
        turning = CameraMotion(se3_exp(-rate / 30), -rate, no_matches, is_measured=True)
        pose = tracked(se3_exp(-rate * n / 30))
        poses.append(n / 30, pose, turning, None, None)
        camera(pose, turning, poses, ids, None)
    at_rest = CameraMotion(EYE, REST, no_matches, is_measured=True)
    poses.append(29 / 30 + gap, pose, at_rest, None, None)
    twist = camera(pose, at_rest, poses, ids, None).twist
    assert float(twist.norm()) < 0.35
