"""Projection matching: match landmarks to features near their predicted image positions (ORB-SLAM2, Sec. III)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.features.features import Features
from v3d_torch.features.projection_search import match_by_projection
from v3d_torch.features.scale_pyramid import octaves_of_levels
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import landmark_projection as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.optim.reprojection import MIN_DEPTH

_MIN_COSINE = 0.5
"""Cosine of the maximum change of viewing direction, 60 degrees; descriptors differ beyond it (ORB-SLAM2)."""

_OCTAVE_MARGIN = 1.2
"""Number of octaves beyond either end of the pyramid at which landmarks are still matched: the expected octave is
rounded, and descriptors tolerate a difference of one octave."""


@dataclass(frozen=True)
class LocalMap:
    """Landmarks that a frame can observe.

    Attributes:
        ids: Landmark ids, ascending, int64, shape :math:`(L,)`.
        points: Positions, world frame, metres, float64, shape :math:`(L, 3)`.
        directions: Unit vectors from the camera that first observed a landmark to the landmark, world frame, float64,
            shape :math:`(L, 3)`.
        reference_distance: Distance at which a landmark appears at octave 0, metres, float64,
            shape :math:`(L,)`.
        descriptors: 256-bit descriptors, uint8, shape :math:`(L, 32)`.
    """

    ids: Tensor
    points: Tensor
    directions: Tensor
    reference_distance: Tensor
    descriptors: Tensor


@dataclass(frozen=True)
class ProjectedLandmarks:
    """Predicted image positions of the V landmarks of a local map that are in view.

    Attributes:
        indices: Indices of the landmarks in the local map, int64, shape :math:`(V,)`.
        uv: Undistorted pixels, float64, shape :math:`(V, 2)`.
        depth: Depth along z, metres, float64, shape :math:`(V,)`.
        octave: Expected octaves, int64, shape :math:`(V,)`.
    """

    indices: Tensor
    uv: Tensor
    depth: Tensor
    octave: Tensor


def _project_compiled(self: ProjectionMatcher, T_cw: Tensor, local_map: LocalMap) -> ProjectedLandmarks:
    columns = T_cw, local_map.points, local_map.directions, local_map.reference_distance
    if any(column.dtype != torch.float64 or column.requires_grad for column in columns):
        return NotImplemented
    pose, points, directions, distances, K, bounds = map(to_array, (*columns, self._camera.K, self.bounds))
    octaves = self.octaves[0], self.octaves[-1]
    projected = kernels.project(pose, points, directions, distances, K, bounds, math.log(self._scale), *octaves)
    return ProjectedLandmarks(*map(torch.from_numpy, projected))


class ProjectionMatcher:
    """Matches landmarks to the features of a frame whose pose is approximately known.

    Args:
        config: Thresholds of descriptor matching.
        features_config: Scale pyramid of the features.
        camera: Intrinsics.

    Attributes:
        octaves: Octaves of the levels of the scale pyramid.
        bounds: Lower (inclusive) and upper bound of (z, u, v, cosine, octave) of a landmark in view, float64,
            shape :math:`(2, 5)`.
    """

    def __init__(self, config: TrackingConfig, features_config: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._scale = features_config.scale
        self.octaves = octaves_of_levels(features_config, camera.width)
        self._camera = camera
        margin = _OCTAVE_MARGIN
        u_min, v_min, u_max, v_max = camera.undistorted_bounds
        lower = [MIN_DEPTH, u_min, v_min, _MIN_COSINE, self.octaves[0] - margin]
        upper = [math.inf, u_max, v_max, math.inf, self.octaves[-1] + margin]
        self.bounds = torch.tensor([lower, upper], dtype=torch.float64)

    def __call__(
        self, features: Features, projection: ProjectedLandmarks, local_map: LocalMap, radius: float
    ) -> Tensor:
        """Match projected landmarks to nearby features with similar descriptors.

        Args:
            features: Features of the frame.
            projection: Landmarks projected into the frame, see `project`.
            local_map: The local map that was projected.
            radius: Search radius, pixels at octave 0; it grows with the octave.

        Returns:
            Pairs (row of ``local_map``, feature), int64, shape :math:`(K, 2)`. Each landmark and each feature occurs at
            most once.
        """
        pairs = match_by_projection(
            projection.uv,
            radius * self._scale ** projection.octave.to(torch.float64),
            projection.octave,
            local_map.descriptors.index_select(0, projection.indices),
            features.uv,
            features.octave,
            features.descriptors,
            max_hamming=self._config.max_hamming,
            max_ratio=self._config.max_ratio,
        )
        return torch.stack([projection.indices[pairs[:, 0]], pairs[:, 1]], dim=1)

    @compiled_by(_project_compiled)
    def project(self, T_cw: Tensor, local_map: LocalMap) -> ProjectedLandmarks:
        """Project a local map into a camera, and select the landmarks in view.

        A landmark is in view if it projects into the image, its viewing direction is similar to that of its first
        observation, and its distance corresponds to an octave of the scale pyramid.

        Args:
            T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
            local_map: Landmarks to project.
        """
        R = T_cw[:3, :3]
        points = torch.addmm(T_cw[:3, 3:], R, local_map.points.T)  # 3 x L, camera frame
        directions = R @ local_map.directions.T  # 3 x L, camera frame
        distance = points.square().sum(dim=0).sqrt()
        z = points[2]
        u, v = (self._camera.K[:2] @ points) / z
        cosine = (points * directions).sum(dim=0) / distance
        octave = torch.log(local_map.reference_distance / distance) / math.log(self._scale)
        predicted = torch.stack([z, u, v, cosine, octave])
        lower, upper = self.bounds[..., None]
        rows = torch.nonzero(((predicted >= lower) & (predicted < upper)).all(dim=0))[:, 0]
        z, u, v, _, octave = predicted.index_select(1, rows)
        nearest = octave.round().clamp(self.octaves[0], self.octaves[-1]).to(torch.int64)
        return ProjectedLandmarks(rows, torch.stack([u, v], dim=1), z, nearest)
