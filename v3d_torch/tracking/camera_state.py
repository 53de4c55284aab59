"""State of the camera at one time: pose and twist with their covariances."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import orthonormalise, se3_exp
from v3d_torch.tracking.motion_model import MAX_EXTRAPOLATION
from v3d_torch.tracking.pose_kalman_filter import join_covariances, predict_covariance, stop_covariance
from v3d_torch.types import TrackingStatus

_LOST_AFTER = 1.0
"""Time without a frame after which the camera counts as lost, seconds: its position is then uncertain by a metre, as
large as a robot, because its motion has been unknown for most of that time."""


@dataclass(frozen=True, kw_only=True)
class CameraState:
    """Pose and motion of the camera at one time.

    Convention: twists and errors are ``[translation, rotation]`` in the camera frame, metres and radians, and multiply
    the pose on the right. Covariances in messages of ROS are along the axes of the world: rotate both halves,
    ``R @ covariance @ R.T`` with ``R = torch.block_diag(T_wc[:3, :3], T_wc[:3, :3])``.

    Attributes:
        stamp: Time, seconds.
        T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`; the world frame is that of the first camera, or
            of the loaded map.
        status: Source of the pose.
        covariance: Covariance of the error xi of the pose, where ``T_wc @ se3_exp(xi)`` is the true pose, float64,
            shape :math:`(6, 6)`.
        twist: Velocity of the camera: after dt seconds the pose is ``T_wc @ se3_exp(twist * dt)``; m/s and rad/s,
            float64, shape :math:`(6,)`.
        twist_covariance: Covariance of the twist, m/s and rad/s, float64, shape :math:`(6, 6)`.
        cross_covariance: Covariance of the errors of pose (rows, metres and radians) and twist (columns, m/s and
            rad/s), float64, shape :math:`(6, 6)`.
    """

    stamp: float
    T_wc: Tensor
    status: TrackingStatus
    covariance: Tensor
    twist: Tensor
    twist_covariance: Tensor
    cross_covariance: Tensor

    def predict(self, stamp: float) -> CameraState:
        """Predict the camera at a later time, with constant twist and growing covariance.

        The predicted camera stops after `MAX_EXTRAPOLATION` seconds, because a handheld camera changes its motion
        within that time; the covariance includes the unknown motion after it. A camera without a frame for more than a
        second has the status `TrackingStatus.LOST`.

        Args:
            stamp: Time, seconds, not before that of this state.

        Raises:
            InputError: If the time is before that of this state, or not finite.
        """
        if not stamp >= self.stamp:  # the covariance would shrink, and become indefinite
            raise InputError(
                f"no prediction for {stamp:.6f} s: the state is of {self.stamp:.6f} s; give a later time, or use"
                " pose_at, which also has earlier times"
            )
        if stamp == math.inf:
            raise InputError("no prediction for inf s: the time is not finite; give seconds")
        joint = join_covariances(self.covariance, self.cross_covariance, self.twist_covariance)
        moving = min(stamp - self.stamp, MAX_EXTRAPOLATION)
        joint, twist = predict_covariance(joint, self.twist, moving), self.twist
        T_wc = orthonormalise(self.T_wc @ se3_exp(twist * moving))
        if stamp - self.stamp > moving:
            joint, twist = stop_covariance(joint, twist), twist * 0
            joint = predict_covariance(joint, twist, stamp - self.stamp - moving)
        return CameraState(
            stamp=stamp,
            T_wc=T_wc,
            status=TrackingStatus.LOST if stamp - self.stamp > _LOST_AFTER else self.status,
            covariance=joint[:6, :6],
            twist=twist,
            twist_covariance=joint[6:, 6:],
            cross_covariance=joint[:6, 6:],
        )
