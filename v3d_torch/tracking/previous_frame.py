"""Refinement of the previous frame: its velocity is known better once the motion after it is measured."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.odometry import TrackedFrame
from v3d_torch.tracking.map_tracker import MapTracker
from v3d_torch.tracking.pose_history import PoseHistory


class PreviousFrameRefinement:
    """Compensates the features of the previous frame again with a better velocity, and refines its pose.

    If the previous frame is the newest keyframe, its features in the map are updated, and the next bundle adjustment
    refines its pose. But if the motion to the keyframe was not measured, as after a gap, the keyframe was tracked
    without a velocity. Then its pose is refined here, and its new landmarks move with it, before the next frame is
    tracked with them.

    Args:
        track_map: Refines a pose.
        sparse_map: Map of the system.
        refine_pose: False to update keyframes only.
    """

    def __init__(self, track_map: MapTracker, sparse_map: SparseMap, *, refine_pose: bool) -> None:
        self._track_map = track_map
        self._map = sparse_map
        self._refine_pose = refine_pose

    def __call__(
        self,
        previous: TrackedFrame | None,
        velocity: Tensor | None,
        poses: PoseHistory,
        compensate: Callable[..., Features],
    ) -> None:
        """Refine the last frame of the history.

        Args:
            previous: Last frame of the history; None before the second frame.
            velocity: Mean velocity around this frame, see `CameraMotion`, float64, shape :math:`(6,)`; None if it is
                not known.
            poses: Poses of all frames so far.
            compensate: Compensation of rolling shutter and depth delay, see `TimeCompensation`.
        """
        if previous is None or previous.landmarks is None or velocity is None or not self._map.keyframes:
            return
        keyframe = self._map.newest_keyframe_at(previous.frame.stamp)
        depth, delay = previous.depth, previous.frame.depth_delay
        if keyframe is not None:
            features = compensate(keyframe.features, depth, delay, velocity, self._map.readout)
            had_velocity = poses.is_motion_measured or not self._refine_pose
            self._map.update_features(keyframe, features, None if had_velocity else self._refine(keyframe, features))
        elif self._refine_pose:
            matched, points = self._map.landmark_positions(previous.landmarks)
            features = compensate(previous.features[matched], depth, delay, velocity, self._map.readout)
            refined = self._track_map.refine(poses.T_cw, points, features, rounds=1)
            if refined is not None:
                poses.replace_last(refined.T_cw)

    def _refine(self, keyframe: Keyframe, features: Features) -> Tensor | None:
        """Refine the pose of a keyframe with the landmarks of earlier keyframes; None if it observes too few of them.

        Args:
            keyframe: Newest keyframe.
            features: Its features, compensated again.
        """
        created = self._map.landmarks["keyframe"][keyframe.landmarks] == keyframe.index
        matched, points = self._map.landmark_positions(keyframe.landmarks.masked_fill(created, -1))
        refined = self._track_map.refine(keyframe.T_cw, points, features[matched], rounds=4)
        return None if refined is None else refined.T_cw
