"""Estimation of the state of the camera at each frame: twist, and covariances of pose and twist."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import adjoint, invert
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.tracking.map_noise import MapNoise
from v3d_torch.tracking.motion_model import MAX_EXTRAPOLATION
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.tracking.pose_kalman_filter import PoseKalmanFilter
from v3d_torch.tracking.pose_noise import PoseNoise
from v3d_torch.types import FramePose, TrackingStatus

_MIN_INFORMATION = 1e-2
"""Number added to the diagonal of information matrices, 1/m^2 and 1/rad^2: that of a standard deviation of 10 m, more
than the size of a room."""


def _covariance(position_sigma: float, rotation_sigma: float) -> Tensor:
    """Covariance of a pose with independent errors, given in metres and radians."""
    return torch.tensor([position_sigma] * 3 + [rotation_sigma] * 3, dtype=torch.float64).square().diag()


_UNKNOWN = _covariance(100.0, torch.pi)
"""Covariance of a camera that was never found: it can be anywhere in a building, with any orientation."""

_FIRST_FRAME_NOISE = _covariance(0.01, 0.01)
"""Noise of frames before any frame is tracked in the map: that of a frame-to-frame motion with a scene at 1 to 2 m."""

_LOST_FOR_A_SECOND = _covariance(1.0, 1.0)
"""Additional covariance of a camera that is lost for a second although its motion is measured, as after a jump: it can
be wherever it could move at walking speed."""

_MAX_GAP = 0.5
"""Time between two frames above which the filter starts again, seconds: a camera at its maximum rotation rate then
turns by more than half a turn, and the difference from its predicted pose is ambiguous."""


class StateEstimator(StatefulComponent):
    """Estimates the state of the camera at each frame.

    The covariance of a pose that was tracked in the map is the sum of the noise of the frame (`PoseNoise`) and of the
    map (`MapNoise`). If only the motion since the previous frame was measured, the noise of a frame is added to the
    previous covariance; a lost camera adds `_LOST_FOR_A_SECOND`, because it may have jumped. Without a measured motion,
    the covariance grows with the uncertainty of the twist (`PoseKalmanFilter`).
    """

    _STATE = (
        "_pose_noise",
        "_map_noise",
        "_filter",
        "_frame_noise",
        "_owners",
        "_covariance",
        "_known_covariance",
        "_last_measured",
        "_last_in_map",
        "_part_covariance_w",
    )

    def __init__(self) -> None:
        self._pose_noise = PoseNoise()
        self._map_noise = MapNoise()
        self._filter = PoseKalmanFilter()
        self._frame_noise = _FIRST_FRAME_NOISE  # of the last pose that was tracked in the map
        self._owners = torch.zeros(0, dtype=torch.int64)  # keyframes that created its landmarks
        self._covariance = _UNKNOWN  # of the last pose
        self._known_covariance = _UNKNOWN  # the same without the growth since the last measured motion
        self._last_measured = self._last_in_map = -torch.inf
        self._part_covariance_w = torch.zeros(6, 6, dtype=torch.float64)  # of the newest disconnected part

    def __call__(
        self, pose: FramePose, motion: CameraMotion, poses: PoseHistory, owners: Tensor, references: Tensor | None
    ) -> CameraState:
        """Estimate the state at a new frame.

        Args:
            pose: Pose as it was tracked.
            motion: Motion of the camera since the previous frame.
            poses: Poses of all frames; the last one is that of the new frame.
            owners: Indices of the keyframes that created the landmarks of the frame, int64, shape :math:`(L,)`.
            references: If the frame has become a keyframe, the reference keyframe of each keyframe of the map, int64,
                shape :math:`(K,)`; else None.
        """
        stamp, T_wc, status = poses.stamp, invert(poses.T_cw), poses.status or pose.status
        defines_world = status is TrackingStatus.TRACKED and pose.information is None  # the first keyframe
        is_in_map = pose.information is not None or defines_world
        if pose.is_relocalised:  # it can have jumped, even if the previous frame was found
            self._pose_noise.interrupt()
        if pose.information is not None:
            self._covariance = self._track(pose.information, stamp, T_wc, owners)
            if status is TrackingStatus.DISCONNECTED:
                self._covariance = self._covariance + _transform(self._part_covariance_w, invert(T_wc))
        elif defines_world:
            self._covariance = torch.zeros(6, 6, dtype=torch.float64)
        else:
            self._pose_noise.interrupt()
            self._covariance = _transform(self._covariance, motion.T_cp) + self._frame_noise
            if status is TrackingStatus.LOST and self._last_in_map > -torch.inf:
                lost_before, lost = self._filter.stamp - self._last_in_map, stamp - self._last_in_map
                self._covariance = self._covariance + (lost**2 - lost_before**2) * _LOST_FOR_A_SECOND
        if is_in_map:
            self._last_in_map = stamp
        if is_in_map or motion.is_measured:
            self._filter_measured(stamp, T_wc, motion, is_continuous=not pose.is_relocalised)
            self._known_covariance, self._last_measured = self._covariance, stamp
        else:
            self._filter_predicted(stamp, T_wc)
            self._known_covariance = _transform(self._known_covariance, motion.T_cp)
            self._covariance = self._known_covariance + self._filter.covariance[:6, :6]
        if references is not None:
            self._add_keyframe(pose.status, status, T_wc, references)
        return CameraState(
            stamp=stamp,
            T_wc=T_wc,
            status=status,
            covariance=self._covariance,
            twist=self._filter.twist,
            twist_covariance=self._filter.covariance[6:, 6:],
            cross_covariance=self._filter.cross_covariance,
        )

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the state into the corrected world frame.

        Args:
            T_new_old: Transform from the old to the corrected world frame, float64, shape :math:`(4, 4)`.
        """
        self._pose_noise.interrupt()
        self._filter.T_wc = T_new_old @ self._filter.T_wc
        self._part_covariance_w = _transform(self._part_covariance_w, T_new_old)

    def _track(self, information: Tensor, stamp: float, T_wc: Tensor, owners: Tensor) -> Tensor:
        """Covariance of a pose that was tracked in the map."""
        nominal = torch.linalg.inv(information + _MIN_INFORMATION * torch.eye(6, dtype=torch.float64))
        self._pose_noise.update(stamp, T_wc, nominal)
        self._frame_noise, covariance = self._pose_noise.scale(nominal, 1.0, 1 + self._map_noise(owners))
        self._owners = owners
        return covariance

    def _filter_measured(self, stamp: float, T_wc: Tensor, motion: CameraMotion, *, is_continuous: bool) -> None:
        """Update the filter with a pose; restart it if the pose does not continue a measured one, or after a gap."""
        is_near = stamp - self._filter.stamp <= _MAX_GAP
        if is_continuous and is_near and self._last_measured == self._filter.stamp:
            self._filter.predict(stamp)
            self._filter.update(T_wc, self._frame_noise)
        else:
            twist = -motion.velocity if motion.is_measured else None  # the twist of the camera, not of the points
            self._filter.start(stamp, T_wc, self._frame_noise, twist)

    def _filter_predicted(self, stamp: float, T_wc: Tensor) -> None:
        """Set the filter to a predicted pose; the predicted camera stops after some time."""
        if not self._filter.is_started:
            self._filter.start(stamp, T_wc, torch.zeros(6, 6, dtype=torch.float64))
        self._filter.predict(stamp)
        self._filter.T_wc = T_wc
        if stamp - self._last_measured >= MAX_EXTRAPOLATION:
            self._filter.stop()

    def _add_keyframe(self, tracked: TrackingStatus, status: TrackingStatus, T_wc: Tensor, references: Tensor) -> None:
        """Add a keyframe to the noise of the map, according to the source of its pose."""
        if tracked is TrackingStatus.TRACKED:
            self._map_noise.add_keyframe(self._owners, references)
        elif tracked is TrackingStatus.ODOMETRY:
            ratio = torch.linalg.solve(self._frame_noise, self._covariance).trace() / 6
            self._map_noise.add_keyframe(self._owners, references, float(ratio))
        else:
            self._map_noise.add_keyframe(self._owners[:0], references)
        if tracked is TrackingStatus.LOST and status is TrackingStatus.DISCONNECTED:
            self._part_covariance_w = _transform(self._covariance, T_wc)


def _transform(covariance: Tensor, T_ba: Tensor) -> Tensor:
    """Transform the covariance of an error from frame a to frame b, float64, shape (6, 6)."""
    Ad = adjoint(T_ba)
    return Ad @ covariance @ Ad.T
