"""State of the camera: twist and covariances of a camera that is lost and found again."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.moving_camera import EYE, frame_pose
from torch import Tensor

from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.tracking.state_estimator import StateEstimator
from v3d_torch.types import FramePose, TrackingStatus

INFORMATION = 1e6 * torch.eye(6, dtype=torch.float64)


class RestingCamera:
    """Estimates the states of a camera whose measured motions are zero, at 30 Hz."""

    def __init__(self) -> None:
        self._estimate, self._poses = StateEstimator(), PoseHistory()

    def __call__(self, pose: FramePose, *, is_measured: bool = True, start: float = 0.0) -> CameraState:
        """Estimate the state at the next frame; ``start`` is the time of the first frame."""
        none = torch.zeros(0, dtype=torch.int64)
        motion = CameraMotion(EYE, torch.zeros(6, dtype=torch.float64), none.reshape(0, 2), is_measured)
        self._poses.append(start + len(self._poses) / 30, pose, motion, None, None)
        return self._estimate(pose, motion, self._poses, none, None)


def tracked(T_cw: Tensor = EYE) -> FramePose:
    return replace(frame_pose(T_cw, landmarks=(0,)), information=INFORMATION)


def test_jump_of_a_camera_that_is_found_again_is_not_a_twist() -> None:
    away = se3_exp(torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    for status in (TrackingStatus.LOST, TrackingStatus.ODOMETRY):
        camera = RestingCamera()
        for _ in range(10):
            camera(tracked())
        for _ in range(15):
            camera(frame_pose(EYE, status))
        for state in (camera(replace(tracked(away), is_relocalised=True)), camera(tracked(away))):
            assert state.twist.norm() < 0.01


def test_covariance_of_a_camera_not_yet_found_is_that_of_an_unknown_pose_at_any_time() -> None:
    camera, start = RestingCamera(), 1.3e9
    state = camera(frame_pose(EYE, TrackingStatus.LOST), is_measured=False, start=start)
    expected = torch.tensor([100.0] * 3 + [torch.pi] * 3, dtype=torch.float64)
    torch.testing.assert_close(state.covariance, expected.square().diag())
    assert torch.equal(state.twist_covariance.diagonal().sqrt(), torch.tensor([1.0] * 3 + [2.0] * 3).double())
    for is_measured in (True, False):
        state = camera(frame_pose(EYE, TrackingStatus.LOST), is_measured=is_measured, start=start)
        torch.testing.assert_close(state.covariance.diagonal().sqrt(), expected, rtol=0.01, atol=0)


def test_covariance_grows_while_a_camera_is_not_found_where_its_measured_motion_leads() -> None:
    """The camera jumped to another place: its frame-to-frame motion is measured there, its pose is only a guess."""
    camera = RestingCamera()
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
