"""Creation of landmarks from the features of a new keyframe (ORB-SLAM2, Sec. III-C)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig
from v3d_torch.features.features import Features, select_evenly
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, transform_points
from v3d_torch.runtime.tensor_table import TensorTable


def select_new_landmarks(features: Features, landmarks: Tensor, max_landmarks: int, cell: int) -> Tensor:
    """Select unmatched features with depth, evenly over the image.

    Distant features are included. Their depth is uncertain and has a low weight, but they constrain the rotation, and
    can be the only features if people cover most of the image.

    Args:
        features: Features of the keyframe.
        landmarks: Id of the landmark matched to each feature, -1 for none, int64, shape :math:`(N,)`.
        max_landmarks: Maximum number of landmarks that the keyframe observes, matched and new.
        cell: Side of a grid cell for the even selection, pixels.

    Returns:
        Indices of the selected features, int64, shape :math:`(S,)`.
    """
    unmatched = torch.nonzero((landmarks < 0) & (features.depth > 0))[:, 0]
    count = max(max_landmarks - int((landmarks >= 0).sum()), 0)
    return unmatched[select_evenly(features.pixel[unmatched], count, cell)]


def landmark_points(T_wc: Tensor, features: Features, camera: PinholeCamera) -> Tensor:
    """Positions of the landmarks that a single keyframe observes.

    Args:
        T_wc: Camera-to-world pose of the keyframe, float64, shape :math:`(4, 4)`.
        features: Features with depth.
        camera: Intrinsics.

    Returns:
        Points, world frame, metres, float64, shape :math:`(N, 3)`.
    """
    return transform_points(T_wc, camera.back_project(features.uv, features.depth))


def create_landmarks(
    table: TensorTable,
    keyframe: int,
    T_cw: Tensor,
    features: Features,
    camera: PinholeCamera,
    features_config: FeaturesConfig,
) -> Tensor:
    """Append one landmark for each feature to the table of landmarks.

    Args:
        table: Landmarks of the map, see `MapTables`.
        keyframe: Index of the keyframe that observes the features.
        T_cw: World-to-camera pose of the keyframe, float64, shape :math:`(4, 4)`.
        features: Features with depth.
        camera: Intrinsics.
        features_config: Scale pyramid of the features.

    Returns:
        Ids of the new landmarks, int64, shape :math:`(N,)`.
    """
    T_wc = invert(T_cw)
    points = landmark_points(T_wc, features, camera)
    ray = points - T_wc[:3, 3]
    distance = ray.norm(dim=1)
    ones = torch.ones(len(features), dtype=torch.int64)
    return table.append(
        point=points,
        direction=ray / distance[:, None],
        reference_distance=distance * features_config.scale ** features.octave.to(torch.float64),
        descriptor=features.descriptors,
        keyframe=keyframe * ones,
        found=ones,
        visible=ones,
        active=ones.to(torch.bool),
    )
