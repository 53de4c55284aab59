"""Tracking of the camera: pose of each frame from the local map, by relocalisation, or from the motion alone."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.mapping.covisibility import covisible_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.tracking.map_tracker import MapTracker, MapTracking
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import FramePose, TrackingStatus


class _PlaceMatch(Protocol):
    @property
    def tracking(self) -> MapTracking: ...


class Relocaliser(Protocol):
    """Finds the pose of a lost camera; implemented by `v3d_torch.backend.loop_closer.LoopCloser`."""

    def relocalise(self, features: Features, sparse_map: SparseMap) -> _PlaceMatch | None:
        """Find the place in the map where the features were observed; None if there is none."""


class CameraTracker:
    """Estimates the pose of a frame in the map.

    Args:
        track_map: Tracks a frame against a local map.
        relocaliser: Finds the pose of a lost camera in the map.
        sparse_map: Map of the system.
        local_keyframes: Number of keyframes whose landmarks make up the local map.
    """

    def __init__(
        self, track_map: MapTracker, relocaliser: Relocaliser, sparse_map: SparseMap, local_keyframes: int
    ) -> None:
        self._track_map = track_map
        self._relocaliser = relocaliser
        self._map = sparse_map
        self._local_keyframes = local_keyframes

    def __call__(
        self,
        features: Features,
        depth: Tensor,
        T_cw: Tensor,
        landmarks: Tensor,
        motion: CameraMotion,
        poses: PoseHistory,
    ) -> FramePose:
        """Estimate the pose of a frame.

        Args:
            features: Static features of the frame.
            depth: Depth of the frame, metres, shape :math:`(1, H, W)`, 0 = no measurement.
            T_cw: Predicted world-to-camera pose, float64, shape :math:`(4, 4)`.
            landmarks: Landmark id of each feature as matched from the previous frame, -1 for none, int64, shape
                :math:`(N,)`.
            motion: Motion of the camera since the previous frame.
            poses: Poses of all earlier frames.
        """
        if self._map.keyframes:
            local_map = self._map.local_map(poses.observed_landmarks, self._local_keyframes)
            tracking = self._track_map(features, T_cw, local_map, landmarks, depth)
            was_in_map = poses.status in (TrackingStatus.TRACKED, TrackingStatus.DISCONNECTED)
            is_relocalised = tracking is None or not was_in_map
            if tracking is None:
                match = self._relocaliser.relocalise(features, self._map)
                tracking = None if match is None else match.tracking
            if tracking is not None:
                self._map.count_matches(tracking.observed_landmarks, tracking.visible)
                return FramePose(
                    TrackingStatus.TRACKED, tracking.T_cw, tracking.landmarks, tracking.information, is_relocalised
                )
        known = motion.is_measured and poses.is_localised
        status = TrackingStatus.ODOMETRY if known else TrackingStatus.LOST
        return FramePose(status, T_cw, torch.full((len(features),), -1, dtype=torch.int64))

    def reference_keyframe(self, pose: FramePose, poses: PoseHistory) -> Keyframe | None:
        """Return the keyframe that shares most landmarks with a frame; None if there is no keyframe.

        The pose of a frame without landmarks continues that of the previous frame. Therefore it has the same reference
        keyframe; the newest keyframe can belong to another part of the map. If the previous frame has none, the newest
        keyframe is returned.

        Args:
            pose: Pose of the frame.
            poses: Poses of all earlier frames.
        """
        keyframes = self._map.keyframes
        best = covisible_keyframes(self._map, pose.observed_landmarks, 1)
        if len(best):
            return keyframes[int(best[0])]
        return poses.keyframe or (keyframes[-1] if keyframes else None)
