"""Tracks a frame against the local map: project, match nearby, refine the pose (paper, Sec. III-E; ORB-SLAM2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.odometry.matching import match_near
from v3d_torch.odometry.orb import Features
from v3d_torch.odometry.refine import refine_pose


@dataclass(frozen=True)
class LocalMap:
    """Landmarks that a frame may see.

    Attributes:
        ids: of the landmarks, ascending, int64, shape :math:`(L,)`.
        points: world frame, metres, float64, shape :math:`(L, 3)`.
        directions: unit vectors from where each was first seen to the landmark, world frame, :math:`(L, 3)`.
        reach: distance at which the landmark would be seen on level 0 of the pyramid, metres, :math:`(L,)`.
        descriptors: uint8, shape :math:`(L, 32)`.
    """

    ids: Tensor
    points: Tensor
    directions: Tensor
    reach: Tensor
    descriptors: Tensor


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

    _MIN_COSINE = 0.5  # a descriptor seen from 60 degrees aside is another one (ORB-SLAM2)
    _LEVEL_SLACK = 1.2  # landmarks a level beyond the pyramid's ends are still tried

    def __init__(self, config: TrackingConfig, features: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._scale = features.scale
        self._levels = features.levels
        self._camera = camera

    def __call__(self, features: Features, T_cw: Tensor, local: LocalMap, carried: Tensor) -> Tracking | None:
        """Track ``features`` from a predicted pose.

        Args:
            features: of the frame, on pixels that stand still.
            T_cw: predicted world-to-camera pose.
            local: landmarks near the prediction.
            carried: id of the landmark behind each feature as far as the frame before tells, -1 for none, int64,
                shape :math:`(N,)`.

        Returns:
            None when fewer than ``min_inliers`` landmarks are found: the camera is lost.
        """
        row = torch.searchsorted(local.ids, carried).clamp(max=max(len(local.ids) - 1, 0))
        feature = torch.nonzero((carried >= 0) & (local.ids[row] == carried))[:, 0] if len(local.ids) else row[:0]
        first = self._refine(features, T_cw, local, torch.stack([row[feature], feature], dim=1))
        if first is None:
            first = self._refine(features, T_cw, local, self._search(features, T_cw, local, self._config.search_radius))
        if first is None:
            return None
        # From the refined pose, what the prediction had put out of reach is found as well, within half the radius.
        pairs = self._search(features, first.T_cw, local, 0.5 * self._config.search_radius)
        return self._refine(features, first.T_cw, local, pairs)

    def _search(self, features: Features, T_cw: Tensor, local: LocalMap, radius: float) -> Tensor:
        """Pairs (row in ``local``, feature) that lie near each other in the image and look alike."""
        seen, projected, levels = self._project(T_cw, local)
        pairs = match_near(
            projected,
            radius * self._scale ** levels.to(torch.float64),
            levels,
            local.descriptors[seen],
            features.uv,
            features.octave,
            features.descriptors,
            max_hamming=self._config.max_hamming,
            max_ratio=self._config.max_ratio,
        )
        return torch.stack([seen[pairs[:, 0]], pairs[:, 1]], dim=1)

    def _refine(self, features: Features, T_cw: Tensor, local: LocalMap, pairs: Tensor) -> Tracking | None:
        """Pose from pairs (row in ``local``, feature); None when too few agree."""
        config = self._config
        if pairs.shape[0] < config.min_inliers:
            return None
        landmark, feature = pairs.unbind(dim=1)
        refined = refine_pose(
            T_cw,
            local.points[landmark],
            features.uv[feature],
            features.inverse_depth[feature],
            config.pixel_sigma * self._scale ** features.octave[feature].to(torch.float64),
            self._camera,
            inverse_depth_sigma=config.inverse_depth_sigma,
        )
        if int(refined.inliers.sum()) < config.min_inliers:
            return None
        ids = torch.full((len(features),), -1, dtype=torch.int64)
        ids[feature[refined.inliers]] = local.ids[landmark[refined.inliers]]
        return Tracking(refined.T_cw, ids, local.ids[self._project(refined.T_cw, local)[0]])

    def _project(self, T_cw: Tensor, local: LocalMap) -> tuple[Tensor, Tensor, Tensor]:
        """Landmarks in view: their rows in ``local``, pixels and expected pyramid levels."""
        points = local.points @ T_cw[:3, :3].T + T_cw[:3, 3]
        distance = points.norm(dim=1)
        pixels = self._camera.project(torch.where(points[:, 2:] > 0.05, points, 1.0))
        centre = -T_cw[:3, :3].T @ T_cw[:3, 3]
        cosine = ((local.points - centre) * local.directions).sum(dim=1) / distance.clamp(min=1e-9)
        level = torch.log(local.reach / distance.clamp(min=1e-9)) / math.log(self._scale)
        inside = (pixels >= 0).all(dim=1) & (pixels[:, 0] < self._camera.width) & (pixels[:, 1] < self._camera.height)
        in_view = (points[:, 2] > 0.05) & inside & (cosine > self._MIN_COSINE)
        in_view &= (level > -self._LEVEL_SLACK) & (level < self._levels - 1 + self._LEVEL_SLACK)
        seen = torch.nonzero(in_view)[:, 0]
        return seen, pixels[seen], level[seen].round().clamp(0, self._levels - 1).to(torch.int64)
