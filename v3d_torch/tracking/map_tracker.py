"""Tracks a frame against the local map: project, match nearby, refine the pose (paper, Sec. III-E; ORB-SLAM2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.features.features import Features, measurements, sample_depth
from v3d_torch.features.projection_matcher import LocalMap, Projection, ProjectionMatcher
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.optim.pose_refinement import PoseRefinement, refine_pose

_ERRS = 2
"""Standard deviations that 95 % of depths err by at most."""


@dataclass(frozen=True)
class Tracking:
    """A frame's pose in the map.

    Attributes:
        T_cw: world to camera, float64, shape :math:`(4, 4)`.
        landmarks: id of the landmark behind each feature, -1 for none, int64, shape :math:`(N,)`.
        visible: ids of the landmarks that should have been seen, int64, shape :math:`(V,)`.
    """

    T_cw: Tensor
    landmarks: Tensor
    visible: Tensor

    @property
    def found(self) -> Tensor:
        """Ids of the landmarks that were found, int64, shape :math:`(F,)`."""
        return self.landmarks[self.landmarks >= 0]

    @property
    def count(self) -> int:
        """Number of landmarks found."""
        return int((self.landmarks >= 0).sum())


class MapTracker:
    """Finds the pose of a frame in the local map.

    Args:
        config: search and noise.
        features: scale pyramid of the features.
        camera: projects the landmarks.
    """

    def __init__(self, config: TrackingConfig, features: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._features = features
        self._camera = camera
        self._search = ProjectionMatcher(config, features, camera)

    def __call__(
        self, features: Features, T_cw: Tensor, local: LocalMap, carried: Tensor, depth: Tensor | None = None
    ) -> Tracking | None:
        """Track ``features`` from a predicted pose.

        Args:
            features: of the frame, on pixels that stand still.
            T_cw: predicted world-to-camera pose.
            local: landmarks near the prediction.
            carried: id of the landmark behind each feature as far as the frame before tells, -1 for none, int64,
                shape :math:`(N,)`.
            depth: image of the view, metres, shape :math:`(1, H, W)`, 0 = none: landmarks behind what it shows are
                hidden, by people most of all, and need not have been seen. None where it is not at hand.

        Returns:
            None when fewer than ``min_inliers`` landmarks are found: the camera is lost.
        """
        row = torch.searchsorted(local.ids, carried).clamp(max=max(len(local.ids) - 1, 0))
        feature = torch.nonzero((carried >= 0) & (local.ids[row] == carried))[:, 0] if len(local.ids) else row[:0]
        first = self.refine(T_cw, local.points[row[feature]], features[feature], rounds=2)
        if first is None:
            seen = self._search.project(T_cw, local)
            landmark, feature = self._search(features, seen, local, self._config.search_radius).unbind(dim=1)
            first = self.refine(T_cw, local.points[landmark], features[feature], rounds=2)
        if first is None:
            return None
        # From the refined pose, what the prediction had put out of reach is found as well, within half the radius.
        seen = self._search.project(first.T_cw, local)
        landmark, feature = self._search(features, seen, local, 0.5 * self._config.search_radius).unbind(dim=1)
        found = self.refine(first.T_cw, local.points[landmark], features[feature], rounds=4)
        if found is None:
            return None
        ids = torch.full((len(features),), -1, dtype=torch.int64)
        ids[feature[found.inliers]] = local.ids[landmark[found.inliers]]
        visible = seen.rows if depth is None else seen.rows[~self._hidden(seen, depth)]
        return Tracking(found.T_cw, ids, local.ids[visible])

    def refine(self, T_cw: Tensor, points: Tensor, features: Features, *, rounds: int) -> PoseRefinement | None:
        """Refine a pose from landmarks that are known to be behind features, but for outliers.

        Args:
            T_cw: world to camera, about.
            points: the landmarks, world frame, metres, float64, shape :math:`(N, 3)`.
            features: that show them.
            rounds: see `refine_pose`.

        Returns:
            None when fewer than ``min_inliers`` agree.
        """
        config = self._config
        if len(features) < config.min_inliers:
            return None
        refined = refine_pose(T_cw, points, measurements(features, config, self._features), self._camera, rounds=rounds)
        return refined if int(refined.inliers.sum()) >= config.min_inliers else None

    def _hidden(self, seen: Projection, depth: Tensor) -> Tensor:
        """Which landmarks lie behind what is seen in their places, by more than depth errs; bool, shape (V,)."""
        z = sample_depth(self._camera.distort(seen.pixels).round().to(torch.int64), depth, torch.inf)
        return (z > 0) & (1 / z - 1 / seen.depth > _ERRS * self._config.inverse_depth_sigma)
