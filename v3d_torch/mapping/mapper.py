"""Local mapping: keyframe decision, keyframe insertion and landmark fusion (ORB-SLAM2, Sec. III-C)."""

from __future__ import annotations

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.landmark_fusion import LandmarkFusion
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.types import FramePose, RGBDFrame, TrackingStatus

_MIN_KEYFRAME_INTERVAL = 4
"""Minimum number of frames between keyframes if the landmarks are few but the view has not changed: where an image
never shows ``mapping.min_tracked`` landmarks, every frame would become a keyframe."""


class Mapper(StatefulComponent):
    """Decides when a frame becomes a keyframe, and inserts the keyframe into the map.

    Args:
        config: Configuration of the whole system.
        camera: Camera of the frames.
        sparse_map: Map to extend, empty or of an earlier run.

    Attributes:
        map: The map.
    """

    _STATE = ("_most_tracked", "_untracked_since", "_frames_since_keyframe", "_last_index")

    def __init__(self, config: Config, camera: PinholeCamera, sparse_map: SparseMap) -> None:
        self._config = config
        self._fuse_landmarks = LandmarkFusion(config, camera)
        self.map = sparse_map
        self._most_tracked = 0  # maximum number of landmarks that a frame matched since the last keyframe
        self._untracked_since: float | None = None  # timestamp, seconds
        self._frames_since_keyframe, self._last_index = 0, -1

    def __call__(
        self, frame: RGBDFrame, features: Features, pose: FramePose, reference: Keyframe | None
    ) -> Keyframe | None:
        """Insert the frame as a keyframe if the map needs one.

        Args:
            frame: The current frame.
            features: Features of the frame on static pixels.
            pose: Pose of the frame, with the landmarks matched to its features.
            reference: Reference keyframe of the frame; None if the map is empty.

        Returns:
            The new keyframe, or None.
        """
        # Dropped frames count; the index of a camera that is started again does not increase.
        self._frames_since_keyframe += max(frame.index - self._last_index, 1)
        self._last_index = frame.index
        if not self._needs_keyframe(frame, features, pose):
            return None
        keyframe = self.map.insert_keyframe(frame.index, frame.stamp, pose.T_cw, features, pose.landmarks)
        if reference is not None:
            keyframe.part = self.map.unused_part if pose.status is TrackingStatus.LOST else reference.part
        self._most_tracked, self._untracked_since, self._frames_since_keyframe = 0, None, 0
        self._fuse_landmarks(self.map, keyframe)
        return keyframe

    def _needs_keyframe(self, frame: RGBDFrame, features: Features, pose: FramePose) -> bool:
        """Decide whether the map needs a keyframe, and update the counters of this decision."""
        config = self._config.mapping
        if not config.enabled:
            return False
        self._most_tracked = max(self._most_tracked, pose.landmark_count)
        if pose.status is not TrackingStatus.TRACKED:
            return self._needs_untracked_keyframe(frame.stamp, features, pose.status)
        self._untracked_since = None
        interval = self._frames_since_keyframe
        if interval >= config.max_keyframe_interval:
            return True
        view_changed = pose.landmark_count < config.min_tracked_ratio * self._most_tracked
        weak = view_changed or (pose.landmark_count < config.min_tracked and interval >= _MIN_KEYFRAME_INTERVAL)
        new_landmarks = (pose.landmarks < 0) & (features.depth > 0)
        return weak and int(new_landmarks.sum()) >= self._config.tracking.min_inliers

    def _needs_untracked_keyframe(self, stamp: float, features: Features, status: TrackingStatus) -> bool:
        """Decide whether to extend the map from a pose that was not tracked in the map.

        This requires that tracking has failed for some time although the image had enough features. A map of an
        earlier run is extended only after relocalisation in that map.
        """
        config = self._config.mapping
        if status is TrackingStatus.LOST and self.map.keyframes and self.map.keyframes[-1].is_from_earlier_run:
            return False
        if int((features.depth > 0).sum()) < config.min_tracked:
            self._untracked_since = None  # the camera is covered: relocalisation has not been possible yet
            return False
        if self._untracked_since is None:
            self._untracked_since = stamp
        delay = config.restart_after if status is TrackingStatus.LOST else config.map_by_odometry_after
        return not self.map.keyframes or stamp - self._untracked_since >= delay
