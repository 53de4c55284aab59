"""Landmarks found again in the keyframes around a new one (ORB-SLAM2, local mapping).

A keyframe makes landmarks of what tracking did not recognise. Many of them its neighbours see as well, as a feature
without a landmark or as a landmark of their own; joined, they tie the keyframes together where else each would hang on
its own depth image.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import to_measurements
from v3d_torch.features.projection_matcher import ProjectionMatcher
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.optim.reprojection import chi_square, reprojection_residuals


class LandmarkFusion:
    """Joins the landmarks of a new keyframe with those of its neighbours.

    Args:
        config: of the whole system.
        camera: of the keyframes.
    """

    def __init__(self, config: Config, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._search = ProjectionMatcher(config.tracking, config.features, camera)

    def __call__(self, sparse_map: SparseMap, keyframe: Keyframe) -> None:
        """Look for the landmarks of a keyframe in its neighbours, and for theirs in it.

        Args:
            sparse_map: whose landmarks and observations are changed in place.
            keyframe: the newest.
        """
        covisible = sparse_map.covisible_keyframes(
            keyframe.landmark_ids, self._config.mapping.fusion_keyframes + 1
        ).tolist()
        neighbours = [sparse_map.keyframes[index] for index in covisible if index != keyframe.index]
        for neighbour in neighbours:
            self._find(sparse_map, keyframe.landmark_ids, neighbour)
        if neighbours:
            self._find(sparse_map, torch.cat([neighbour.landmark_ids for neighbour in neighbours]).unique(), keyframe)

    def _find(self, sparse_map: SparseMap, landmarks: Tensor, keyframe: Keyframe) -> None:
        """Find those landmarks that a keyframe sees without knowing."""
        features, config = keyframe.features, self._config
        local = sparse_map.select_landmarks(
            landmarks[~sparse_map.is_among(landmarks, keyframe.landmark_ids)].sort().values
        )
        seen = self._search.project(keyframe.T_cw, local)
        row, feature = self._search(features, seen, local, config.mapping.fuse_radius).unbind(dim=1)
        in_camera = local.points[row] @ keyframe.T_cw[:3, :3].T + keyframe.T_cw[:3, 3]
        measured = to_measurements(features[feature], config.tracking, config.features)
        fits = (
            chi_square(in_camera, reprojection_residuals(in_camera, measured, self._camera)) <= measured.chi2_threshold
        )
        found = torch.full_like(keyframe.landmarks, -1)
        found[feature[fits]] = local.ids[row[fits]]
        sparse_map.fuse_landmarks(keyframe, found)
