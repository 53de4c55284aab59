"""Tracking of a frame against the local map: projection, matching, pose refinement (paper, Sec. III-E; ORB-SLAM2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.features.features import Features, sample_depth, to_measurements
from v3d_torch.features.projection_matcher import LocalMap, ProjectedLandmarks, ProjectionMatcher
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.optim.pose_refinement import PoseRefinement, refine_pose_unchecked
from v3d_torch.types import LandmarkObserver

_SEARCH_RADIUS = 10.0
"""Search radius around the projection of a landmark, pixels at octave 0; it grows with the octave. The error of a
predicted pose is some pixels."""

_REFINED_SEARCH_RATIO = 0.5
"""Fraction of the search radius that the second search uses, which starts from a refined pose."""

_OCCLUSION_SIGMAS = 2.0
"""Minimum distance of an occluded landmark behind the measured depth, in standard deviations."""


@dataclass(frozen=True)
class MapTracking(LandmarkObserver):
    """Pose of a frame in the map.

    Attributes:
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
        landmarks: Landmark id of each feature, -1 for none, int64, shape :math:`(N,)`.
        visible: Ids of the landmarks that the frame should have observed, int64, shape :math:`(V,)`.
        information: Information matrix of the left perturbation of ``T_cw``, float64, shape :math:`(6, 6)`.
    """

    T_cw: Tensor
    landmarks: Tensor
    visible: Tensor
    information: Tensor


class MapTracker:
    """Estimates the pose of a frame in the local map.

    Args:
        config: Matching thresholds and noise.
        features_config: Scale pyramid of the features.
        camera: Camera of all frames.
    """

    def __init__(self, config: TrackingConfig, features_config: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._features_config = features_config
        self._camera = camera
        self._match = ProjectionMatcher(config, features_config, camera)

    def __call__(
        self, features: Features, T_cw: Tensor, local_map: LocalMap, landmarks: Tensor, depth: Tensor | None = None
    ) -> MapTracking | None:
        """Track a frame from a predicted pose.

        Args:
            features: Static features of the frame.
            T_cw: Predicted world-to-camera pose, float64, shape :math:`(4, 4)`.
            local_map: Landmarks near the prediction.
            landmarks: Landmark id of each feature as matched from the previous frame, -1 for none, int64, shape
                :math:`(N,)`.
            depth: Depth of the frame, metres, shape :math:`(1, H, W)`, 0 = no measurement. Landmarks behind it are
                occluded, mostly by people, and do not count as visible. None if it is not known.

        Returns:
            None if fewer than ``min_inliers`` landmarks are found: the camera is lost.
        """
        # Landmarks matched by the frame-to-frame motion need no search.
        row = torch.searchsorted(local_map.ids, landmarks).clamp(max=max(len(local_map.ids) - 1, 0))
        in_local_map = torch.zeros_like(landmarks, dtype=torch.bool)
        if len(local_map.ids):
            in_local_map = (landmarks >= 0) & (local_map.ids[row] == landmarks)
        feature = torch.nonzero(in_local_map)[:, 0]
        first = self.refine(T_cw, local_map.points[row[feature]], features[feature], rounds=2)
        if first is None:
            projected = self._match.project(T_cw, local_map)
            landmark, feature = self._match(features, projected, local_map, _SEARCH_RADIUS).unbind(dim=1)
            first = self.refine(T_cw, local_map.points[landmark], features[feature], rounds=2)
        if first is None:
            return None
        # With the refined pose, the projections of the remaining landmarks are close enough to their features.
        projected = self._match.project(first.T_cw, local_map)
        radius = _REFINED_SEARCH_RATIO * _SEARCH_RADIUS
        landmark, feature = self._match(features, projected, local_map, radius).unbind(dim=1)
        refined = self.refine(first.T_cw, local_map.points[landmark], features[feature], rounds=4)
        if refined is None:
            return None
        ids = torch.full((len(features),), -1, dtype=torch.int64)
        ids[feature[refined.inliers]] = local_map.ids[landmark[refined.inliers]]
        visible = projected.indices[self._is_visible(projected, depth)]
        return MapTracking(refined.T_cw, ids, local_map.ids[visible], refined.information)

    def refine(self, T_cw: Tensor, points: Tensor, features: Features, *, rounds: int) -> PoseRefinement | None:
        """Refine a pose from matches of landmarks and features, some of which can be outliers.

        Args:
            T_cw: Initial world-to-camera pose, float64, shape :math:`(4, 4)`.
            points: Landmark of each feature, world frame, metres, float64, shape :math:`(N, 3)`.
            features: Matched features.
            rounds: Maximum number of rounds, see `refine_pose`.

        Returns:
            None if fewer than ``min_inliers`` matches agree.
        """
        config = self._config
        if len(features) < config.min_inliers:
            return None
        measured = to_measurements(features, config, self._features_config)
        refined = refine_pose_unchecked(T_cw, points, measured, self._camera.K, rounds=rounds)
        return refined if int(refined.inliers.sum()) >= config.min_inliers else None

    def _is_visible(self, projected: ProjectedLandmarks, depth: Tensor | None) -> Tensor:
        """Return the mask of the landmarks in the image, and not behind the measured depth, bool, shape (V,).

        Landmarks are matched in the undistorted image. Where it is larger than the recorded image, as for a wide lens,
        landmarks outside the recorded image cannot be observed; see `PinholeCamera.undistorted_bounds`.
        """
        pixels = self._camera.distort(projected.uv)
        size = pixels.new_tensor([self._camera.width, self._camera.height])
        in_recorded, in_undistorted = (((uv >= 0) & (uv < size)).all(dim=1) for uv in (pixels, projected.uv))
        in_image = in_recorded | in_undistorted
        if depth is None:
            return in_image
        z = sample_depth(pixels.round().to(torch.int64), depth, torch.inf)
        is_occluded = (z > 0) & (1 / z - 1 / projected.depth > _OCCLUSION_SIGMAS * self._config.inverse_depth_sigma)
        return in_image & ~is_occluded
