"""Pose history and motion model of a camera with constant twist."""

from __future__ import annotations

import itertools

import torch
from hypothesis import strategies as st
from torch import Tensor

from helpers.sparse_maps import EYE, no_features
from v3d_torch.geometry.se3 import se3_exp, se3_log
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.motion_model import MotionModel
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import FramePose, TrackingStatus, Trajectory

TWIST = torch.tensor([0.3, -0.1, 0.2, 0.1, 0.4, -0.3], dtype=torch.float64)  # m/s and rad/s

_INDICES = itertools.count()

twists = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(lambda v: torch.tensor(v, dtype=torch.float64))


def keyframe(T_cw: Tensor = EYE, stamp: float = 0.0, landmarks: int = 0, part: int = 0) -> Keyframe:
    """A keyframe at a pose that observes the first ``landmarks`` landmarks, without features."""
    index = next(_INDICES)
    return Keyframe(index, index, stamp, T_cw, no_features(), torch.arange(landmarks), part)


def frame_pose(
    T_cw: Tensor, status: TrackingStatus = TrackingStatus.TRACKED, landmarks: tuple[int, ...] = ()
) -> FramePose:
    return FramePose(status, T_cw, torch.tensor(landmarks, dtype=torch.int64))


class Camera:
    """Pose history and motion model of one camera, updated together as `V3DSLAM.track` does."""

    def __init__(self) -> None:
        self.poses = PoseHistory()
        self.model = MotionModel()
        self.previous_velocity: Tensor | None = None  # of the frame before the last one

    def predict(self, stamp: float) -> Tensor:
        return self.model.predict(self.poses).pose_at(stamp)

    def append(
        self,
        stamp: float,
        pose: FramePose,
        reference: Keyframe | None,
        T_cp: Tensor | None = None,
        new: Keyframe | None = None,
    ) -> Tensor | None:
        """Append a frame; ``T_cp`` is the measured motion since the previous one, None if it is not measured."""
        predicted, pairs = self.model.predict(self.poses), torch.zeros(0, 2, dtype=torch.int64)
        if T_cp is None:
            motion = CameraMotion(predicted.motion_until(stamp), predicted.velocity_at(stamp), pairs, is_measured=False)
        else:
            motion = CameraMotion(T_cp, se3_log(T_cp) / (stamp - self.poses.stamp), pairs, is_measured=True)
        self.previous_velocity = self.model.previous_velocity(self.poses, motion)
        self.model.update(self.poses, stamp, pose, motion)
        return self.poses.append(stamp, pose, motion, reference, new)

    def trajectory(self) -> Trajectory:
        return self.poses.trajectory()


def walk(stamps: list[float], lost: tuple[int, ...] = (), reference: Keyframe | None = None) -> Camera:
    """Frames of a camera with constant twist; lost frames get their predicted poses."""
    camera = Camera()
    for index, stamp in enumerate(stamps):
        if index in lost:
            camera.append(stamp, frame_pose(camera.predict(stamp), TrackingStatus.LOST), reference)
        else:
            camera.append(stamp, frame_pose(se3_exp(TWIST * stamp)), reference)
    return camera
