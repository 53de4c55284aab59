"""Constant-velocity motion model of the camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import MIN_INTERVAL, FramePose, TrackingStatus

MAX_EXTRAPOLATION = 0.2
"""Maximum time over which a velocity is extrapolated, seconds: a handheld camera changes its motion within that time. A
camera that is lost for longer is predicted to stand still."""


@dataclass(frozen=True)
class PosePrediction:
    """Prediction of the camera motion after a frame.

    Attributes:
        stamp: Time of the frame, seconds.
        T_cw: World-to-camera pose of the frame, float64, shape :math:`(4, 4)`.
        velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, float64, shape
            :math:`(6,)`.
    """

    stamp: float
    T_cw: Tensor
    velocity: Tensor

    def motion_until(self, stamp: float) -> Tensor:
        """Motion ``T_cp`` from the camera at the frame to the camera at ``stamp``, float64, shape :math:`(4, 4)`."""
        return se3_exp(self.velocity * min(stamp - self.stamp, MAX_EXTRAPOLATION))

    def velocity_at(self, stamp: float) -> Tensor:
        """Velocity expected at ``stamp``, float64, shape :math:`(6,)`; zero if it is too late to extrapolate."""
        return self.velocity * (stamp - self.stamp < MAX_EXTRAPOLATION)

    def pose_at(self, stamp: float) -> Tensor:
        """World-to-camera pose at ``stamp``, float64, shape :math:`(4, 4)`."""
        return self.motion_until(stamp) @ self.T_cw


class MotionModel(StatefulComponent):
    """Estimates how static points move in the camera frame, from the poses of the frames.

    Attributes:
        velocity: Twist of static points in the camera frame after the last frame, as in `PosePrediction`.
    """

    _STATE = ("velocity",)

    def __init__(self) -> None:
        self.velocity = torch.zeros(6, dtype=torch.float64)

    def predict(self, poses: PoseHistory) -> PosePrediction:
        """Predict the motion after the last frame; before the first frame, a camera at rest in the origin."""
        stamp = poses.stamp if len(poses) else 0.0
        return PosePrediction(stamp, poses.T_cw, self.velocity)

    def previous_velocity(self, poses: PoseHistory, motion: CameraMotion) -> Tensor | None:
        """Mean velocity around the last frame, from the motion before and after it.

        Args:
            poses: Poses of all frames so far.
            motion: Motion of the camera since the last of these frames.

        Returns:
            Velocity, see `CameraMotion`, float64, shape :math:`(6,)`; None if it is not known.
        """
        if not len(poses) or poses.status is TrackingStatus.LOST or not motion.is_measured:
            return None
        return (self.velocity + motion.velocity) / 2 if poses.is_motion_measured else motion.velocity

    def update(self, poses: PoseHistory, stamp: float, pose: FramePose, motion: CameraMotion) -> None:
        """Update the velocity with a new frame.

        Args:
            poses: Poses of all earlier frames.
            stamp: Time of the new frame, seconds.
            pose: Pose of the new frame.
            motion: Motion of the camera since the previous frame.
        """
        if not len(poses):
            return
        elapsed = stamp - poses.stamp
        if pose.status is TrackingStatus.LOST or pose.is_relocalised:
            last = self.velocity * (stamp - poses.last_found < MAX_EXTRAPOLATION)
            self.velocity = motion.velocity if motion.is_measured else last
        elif poses.status is not TrackingStatus.LOST and elapsed > 0:
            self.velocity = se3_log(pose.T_cw @ invert(poses.T_cw)) / max(elapsed, MIN_INTERVAL)
