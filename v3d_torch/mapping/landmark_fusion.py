"""Landmark fusion between a new keyframe and its neighbours (ORB-SLAM2, local mapping: SearchInNeighbors).

A new keyframe creates landmarks from the features that tracking did not match. Many of the same points are already
features or landmarks of neighbouring keyframes. Fusing them connects the keyframes; without fusion each keyframe would
depend on its own depth image alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import to_measurements
from v3d_torch.features.projection_matcher import ProjectionMatcher
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.mapping.covisibility import covisible_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.membership import contains
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.optim.reprojection import chi_square, reprojection_residuals

_SEARCH_RADIUS = 3.0
"""Search radius of the projection matching, pixels at octave 0 (ORB-SLAM2); small, because both poses are
known."""


class LandmarkFusion:
    """Fuses the landmarks of a new keyframe with those of its covisible keyframes.

    Args:
        config: Configuration of the whole system.
        camera: Camera of the keyframes.
    """

    def __init__(self, config: Config, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._match = ProjectionMatcher(config.tracking, config.features, camera)

    def __call__(self, sparse_map: SparseMap, keyframe: Keyframe) -> None:
        """Match the landmarks of a keyframe in its neighbours, and the landmarks of the neighbours in the keyframe.

        Args:
            sparse_map: Map; its landmarks and observations are changed in place.
            keyframe: The newest keyframe.
        """
        covisible = covisible_keyframes(
            sparse_map, keyframe.observed_landmarks, self._config.mapping.fusion_keyframes + 1
        ).tolist()
        neighbours = [sparse_map.keyframes[index] for index in covisible if index != keyframe.index]
        for neighbour in neighbours:
            self._fuse(sparse_map, keyframe.observed_landmarks, neighbour)
        if neighbours:
            landmarks = torch.cat([neighbour.observed_landmarks for neighbour in neighbours]).unique()
            self._fuse(sparse_map, landmarks, keyframe)

    def _fuse(self, sparse_map: SparseMap, landmarks: Tensor, keyframe: Keyframe) -> None:
        """Match landmarks to features of a keyframe by projection, and fuse the matches."""
        features, config = keyframe.features, self._config
        observed = contains(keyframe.observed_landmarks.numpy(), landmarks.numpy(), len(sparse_map.landmarks))
        local = sparse_map.select_landmarks(landmarks[~torch.from_numpy(observed)].sort().values)
        projected = self._match.project(keyframe.T_cw, local)
        row, feature = self._match(features, projected, local, _SEARCH_RADIUS).unbind(dim=1)
        # Reject matches by reprojection error, depth included.
        in_camera = transform_points(keyframe.T_cw, local.points[row])
        measured = to_measurements(features[feature], config.tracking, config.features)
        inliers = (
            chi_square(in_camera, reprojection_residuals(in_camera, measured, self._camera.K))
            <= measured.chi2_threshold
        )
        matches = torch.full_like(keyframe.landmarks, -1)
        matches[feature[inliers]] = local.ids[row[inliers]]
        sparse_map.fuse_landmarks(keyframe, matches)
