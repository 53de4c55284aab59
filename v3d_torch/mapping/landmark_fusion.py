"""Landmark fusion between a new keyframe and its neighbours (ORB-SLAM2, local mapping: SearchInNeighbors).

A new keyframe creates landmarks from the features that tracking did not match. Many of the same points are already
features or landmarks of neighbouring keyframes. Fusing them connects the keyframes; without fusion each keyframe would
depend on its own depth image alone.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import to_measurements
from v3d_torch.features.matching import as_words
from v3d_torch.features.projection_matcher import ProjectionMatcher
from v3d_torch.features.projection_search import CELL
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.kernels import landmark_fusion as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.mapping.covisibility import covisible_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.membership import contains
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.optim.reprojection import (
    CHI2_THRESHOLD_2D,
    CHI2_THRESHOLD_3D,
    MIN_DEPTH,
    chi_square,
    reprojection_residuals,
)

_SEARCH_RADIUS = 3.0
"""Search radius of the projection matching, pixels at octave 0 (ORB-SLAM2); small, because both poses are
known."""


def _find_matches_compiled(
    self: LandmarkFusion, sparse_map: SparseMap, landmarks: Tensor, keyframe: Keyframe
) -> Tensor:
    features, table, config = keyframe.features, sparse_map.landmarks, self._config
    measured = features.uv, features.depth, features.sigma_ratio, keyframe.T_cw
    if any(column.dtype != torch.float64 or column.requires_grad for column in measured):
        return NotImplemented
    if len(features) == 0:
        return torch.full_like(keyframe.landmarks, -1)
    names = "active", "point", "direction", "reference_distance"
    arguments: tuple[Any, ...] = (
        *map(to_array, (landmarks, keyframe.landmarks, *(table[name] for name in names))),
        *map(as_words, (table["descriptor"], features.descriptors)),
        *map(to_array, (features.octave, *measured, self._camera.K, self._match.bounds)),
        *(self._match.octaves[0], self._match.octaves[-1], config.features.scale),
        *(_SEARCH_RADIUS, CELL, config.tracking.max_hamming, config.tracking.max_ratio),
        *(config.tracking.pixel_sigma, config.tracking.inverse_depth_sigma),
        *(CHI2_THRESHOLD_2D, CHI2_THRESHOLD_3D, MIN_DEPTH),
    )
    return torch.from_numpy(kernels.find_matches(*arguments))


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
            sparse_map.fuse_landmarks(neighbour, self._find_matches(sparse_map, keyframe.landmarks, neighbour))
        if neighbours:
            landmarks = torch.cat([neighbour.landmarks for neighbour in neighbours])
            sparse_map.fuse_landmarks(keyframe, self._find_matches(sparse_map, landmarks, keyframe))

    @compiled_by(_find_matches_compiled)
    def _find_matches(self, sparse_map: SparseMap, landmarks: Tensor, keyframe: Keyframe) -> Tensor:
        """Match landmarks that a keyframe does not observe to its features, by projection.

        Args:
            sparse_map: The map.
            landmarks: Ids of landmarks, -1 for none, in any order, int64, shape :math:`(L,)`.
            keyframe: Keyframe of the map.

        Returns:
            Id of the landmark matched to each feature of the keyframe, -1 for none, int64, shape :math:`(N,)`.
        """
        features, config = keyframe.features, self._config
        ids = landmarks[landmarks >= 0].unique()
        observed = contains(keyframe.landmarks.numpy(), ids.numpy(), len(sparse_map.landmarks))
        local = sparse_map.select_landmarks(ids[~torch.from_numpy(observed)])
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
        return matches
