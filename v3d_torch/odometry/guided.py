"""Guided search: landmarks are looked for where a pose says they should appear (ORB-SLAM2, Sec. III)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.odometry.matching import match_near
from v3d_torch.odometry.orb import Features


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
class Projection:
    """Landmarks as they should appear in an image.

    Attributes:
        rows: of the local map, those in view, int64, shape :math:`(V,)`.
        pixels: shape :math:`(V, 2)`.
        levels: of the scale pyramid, int64, shape :math:`(V,)`.
    """

    rows: Tensor
    pixels: Tensor
    levels: Tensor


class GuidedSearch:
    """Finds landmarks among the features of a view whose pose is about known.

    Args:
        config: what counts as alike.
        features: scale pyramid of the features.
        camera: projects the landmarks.
    """

    _MIN_COSINE = 0.5  # a descriptor seen from 60 degrees aside is another one (ORB-SLAM2)
    _LEVEL_SLACK = 1.2  # landmarks a level beyond the pyramid's ends are still tried
    _NEAREST = 0.05  # metres: no camera sees nearer

    def __init__(self, config: TrackingConfig, features: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._scale = features.scale
        self._levels = features.levels
        self._camera = camera

    def __call__(self, features: Features, T_cw: Tensor, local: LocalMap, radius: float) -> Tensor:
        """Pairs (row in ``local``, feature) that lie near each other in the image and look alike.

        Args:
            features: of the view.
            T_cw: its pose, world to camera, float64, shape :math:`(4, 4)`.
            local: landmarks.
            radius: around their projections, pixels at level 0; grows with the level.

        Returns:
            Each landmark and each feature at most once, int64, shape :math:`(K, 2)`.
        """
        seen = self.project(T_cw, local)
        pairs = match_near(
            seen.pixels,
            radius * self._scale ** seen.levels.to(torch.float64),
            seen.levels,
            local.descriptors[seen.rows],
            features.uv,
            features.octave,
            features.descriptors,
            max_hamming=self._config.max_hamming,
            max_ratio=self._config.max_ratio,
        )
        return torch.stack([seen.rows[pairs[:, 0]], pairs[:, 1]], dim=1)

    def project(self, T_cw: Tensor, local: LocalMap) -> Projection:
        """The landmarks that a camera at ``T_cw`` should see, about as they were seen before."""
        points = local.points @ T_cw[:3, :3].T + T_cw[:3, 3]
        distance = points.norm(dim=1).clamp(min=1e-9)
        in_front = points[:, 2] > self._NEAREST
        pixels = self._camera.project(torch.where(in_front[:, None], points, 1.0))
        centre = -T_cw[:3, :3].T @ T_cw[:3, 3]
        cosine = ((local.points - centre) * local.directions).sum(dim=1) / distance
        level = torch.log(local.reach / distance) / math.log(self._scale)
        inside = (pixels >= 0).all(dim=1) & (pixels[:, 0] < self._camera.width) & (pixels[:, 1] < self._camera.height)
        in_view = in_front & inside & (cosine > self._MIN_COSINE)
        in_view &= (level > -self._LEVEL_SLACK) & (level < self._levels - 1 + self._LEVEL_SLACK)
        rows = torch.nonzero(in_view)[:, 0]
        return Projection(rows, pixels[rows], level[rows].round().clamp(0, self._levels - 1).to(torch.int64))
