"""The pose of a frame by the best that can be had: the map, a place seen before, the motion since the last frame."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.backend.loop_closer import LoopCloser
from v3d_torch.features.features import Features
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.tracking.map_tracker import MapTracker
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import FramePose, TrackingStatus


class CameraTracker:
    """Finds the camera.

    Args:
        track: finds a frame in a local map.
        places: finds it where it was before.
        sparse_map: of the system.
        local_keyframes: keyframes that make up a local map.
    """

    def __init__(self, track: MapTracker, places: LoopCloser, sparse_map: SparseMap, local_keyframes: int) -> None:
        self._track = track
        self._places = places
        self._map = sparse_map
        self._local_keyframes = local_keyframes

    def __call__(
        self, static: Features, depth: Tensor, T_cw: Tensor, carried: Tensor, poses: PoseHistory, *, moved: bool
    ) -> FramePose:
        """Pose in the local map, else in a place seen before, else by the motion alone, else lost.

        Args:
            static: features on what stands still.
            depth: of the frame, metres, shape :math:`(1, H, W)`, 0 = none.
            T_cw: predicted, by the motion where it is known, float64, shape :math:`(4, 4)`.
            carried: id of the landmark behind each feature as far as the last frame tells, -1 for none.
            poses: of the frames before.
            moved: whether the motion since the last frame is known.
        """
        if self._map.keyframes:
            local = self._map.local_map(poses.landmarks, self._local_keyframes)
            tracking = self._track(static, T_cw, local, carried, depth)
            if tracking is None:
                place = self._places.relocalise(static, self._map)
                tracking = place.tracking if place is not None else None
            if tracking is not None:
                self._map.count_matches(tracking.found, tracking.visible)
                return FramePose(TrackingStatus.TRACKED, tracking.T_cw, tracking.landmarks)
        known = moved and poses.status in (TrackingStatus.TRACKED, TrackingStatus.ODOMETRY)
        nothing = torch.full((len(static),), -1, dtype=torch.int64)
        return FramePose(TrackingStatus.ODOMETRY if known else TrackingStatus.LOST, T_cw, nothing)

    def again(self, features: Features, points: Tensor, poses: PoseHistory) -> None:
        """Refine the pose of the frame before the last, now that it is known better what that saw.

        Args:
            features: of that frame, put right.
            points: the landmarks that they show, world frame, metres, float64, shape :math:`(L, 3)`.
            poses: of all frames.
        """
        refined = self._track.refine(poses.T_pw, points, features, rounds=1)
        if refined is not None:
            poses.correct(refined.T_cw)

    def reference(self, estimate: FramePose) -> Keyframe | None:
        """The keyframe that shares most with the frame, else the last one; None while there is none."""
        keyframes = self._map.keyframes
        best = self._map.covisible_keyframes(estimate.landmarks[estimate.landmarks >= 0], 1)
        return keyframes[int(best[0])] if len(best) else (keyframes[-1] if keyframes else None)
