"""Guided search: landmarks are looked for where a pose says they should appear (ORB-SLAM2, Sec. III)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.features.matching import match_near
from v3d_torch.features.orb import Features
from v3d_torch.geometry.camera import PinholeCamera


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
    reference_distance: Tensor
    descriptors: Tensor


@dataclass(frozen=True)
class Projection:
    """Landmarks as they should appear in an image.

    Attributes:
        rows: of the local map, those in view, int64, shape :math:`(V,)`.
        pixels: undistorted, shape :math:`(V, 2)`.
        depth: along z, metres, shape :math:`(V,)`.
        levels: of the scale pyramid, int64, shape :math:`(V,)`.
    """

    rows: Tensor
    pixels: Tensor
    depth: Tensor
    levels: Tensor


class ProjectionMatcher:
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
        # Of z, u, v, cosine and level, in this order, for a landmark that is in sight.
        slack = self._LEVEL_SLACK
        least = [self._NEAREST, 0.0, 0.0, self._MIN_COSINE, -slack]
        beyond = [math.inf, camera.width, camera.height, math.inf, features.levels - 1 + slack]
        self._least, self._beyond = torch.tensor([least, beyond], dtype=torch.float64)[..., None]

    def __call__(self, features: Features, seen: Projection, local: LocalMap, radius: float) -> Tensor:
        """Pairs (row in ``local``, feature) that lie near each other in the image and look alike.

        Args:
            features: of the view.
            seen: the landmarks as `project` puts them into it.
            local: landmarks.
            radius: around their projections, pixels at level 0; grows with the level.

        Returns:
            Each landmark and each feature at most once, int64, shape :math:`(K, 2)`.
        """
        pairs = match_near(
            seen.pixels,
            radius * self._scale ** seen.levels.to(torch.float64),
            seen.levels,
            local.descriptors.index_select(0, seen.rows),
            features.uv,
            features.octave,
            features.descriptors,
            max_hamming=self._config.max_hamming,
            max_ratio=self._config.max_ratio,
        )
        return torch.stack([seen.rows[pairs[:, 0]], pairs[:, 1]], dim=1)

    def project(self, T_cw: Tensor, local: LocalMap) -> Projection:
        """The landmarks that a camera at ``T_cw`` should see, about as they were seen before."""
        R = T_cw[:3, :3]
        points, directions = torch.addmm(T_cw[:3, 3:], R, local.points.T), R @ local.directions.T  # 3 x L
        distance = points.square().sum(dim=0).sqrt()
        z = points[2]
        u, v = (self._camera.K[:2] @ points) / z
        cosine = (points * directions).sum(dim=0) / distance
        level = torch.log(local.reference_distance / distance) / math.log(self._scale)
        found = torch.stack([z, u, v, cosine, level])
        rows = torch.nonzero(((found >= self._least) & (found < self._beyond)).all(dim=0))[:, 0]
        z, u, v, _, level = found.index_select(1, rows)
        levels = level.round().clamp(0, self._levels - 1).to(torch.int64)
        return Projection(rows, torch.stack([u, v], dim=1), z, levels)
