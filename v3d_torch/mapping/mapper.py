"""Decides when a frame becomes a keyframe, and grows the map with it (ORB-SLAM2, local mapping)."""

from __future__ import annotations

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.landmark_fusion import LandmarkFusion
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.types import FramePose, RGBDFrame, TrackingStatus


class Mapper:
    """Grows a map.

    Args:
        config: of the whole system.
        camera: of the frames.
        known: map to go on with; None to begin a new one.
    """

    def __init__(self, config: Config, camera: PinholeCamera, known: SparseMap | None = None) -> None:
        self._config = config
        self._most_tracked = 0  # landmarks found by a frame since the last keyframe
        self._untracked_since: float | None = None
        self._search_neighbours = LandmarkFusion(config, camera)
        if known is None:
            known = SparseMap(config.mapping, config.features, camera)
            if config.rolling_shutter.enabled:
                known.readout = Readout.from_camera(camera, config.rolling_shutter)
        self.map = known

    def __call__(
        self, frame: RGBDFrame, static: Features, estimate: FramePose, reference: Keyframe | None
    ) -> Keyframe | None:
        """Make ``frame`` a keyframe if the map needs one.

        Args:
            frame: newest.
            static: its features on what stands still.
            estimate: its pose.
            reference: the keyframe that the frame is tied to; None while there is none.

        Returns:
            The new keyframe, or None.
        """
        if not self._wants(frame, static, estimate):
            return None
        keyframe = self.map.insert_keyframe(frame.index, frame.stamp, estimate.T_cw, static, estimate.landmarks)
        keyframe.disconnected = reference is not None and (
            estimate.status is TrackingStatus.LOST or reference.disconnected
        )
        self._most_tracked, self._untracked_since = 0, None
        self._search_neighbours(self.map, keyframe)
        return keyframe

    def _wants(self, frame: RGBDFrame, static: Features, estimate: FramePose) -> bool:
        config = self._config.mapping
        if not config.enabled:
            return False
        self._most_tracked = max(self._most_tracked, estimate.count)
        if estimate.status is not TrackingStatus.TRACKED:
            return self._may_go_on(frame.stamp, static, estimate.status)
        self._untracked_since = None
        weak = estimate.count < max(config.min_tracked, config.min_tracked_ratio * self._most_tracked)
        return weak or frame.index - self.map.keyframes[-1].frame >= config.max_keyframe_interval

    def _may_go_on(self, stamp: float, static: Features, status: TrackingStatus) -> bool:
        """Without the map for some time, a camera maps on from where it is thought to be, once it sees enough.

        A map of an earlier run is gone on with from a place that is found in it, and from no other.
        """
        config = self._config.mapping
        if status is TrackingStatus.LOST and self.map.keyframes and self.map.keyframes[-1].is_from_earlier_run:
            return False
        if int((static.depth > 0).sum()) < config.min_tracked:
            self._untracked_since = None  # a camera that is covered is not yet looking for its place
            return False
        if self._untracked_since is None:
            self._untracked_since = stamp
        patience = config.restart_after if status is TrackingStatus.LOST else config.map_by_odometry_after
        return not self.map.keyframes or stamp - self._untracked_since >= patience
