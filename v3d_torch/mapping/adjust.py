"""Local bundle adjustment: a new keyframe, its neighbours and what they see (ORB-SLAM2, local mapping)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import Config
from v3d_torch.lie import rigid
from v3d_torch.mapping.bundle import Observations, bundle_adjust
from v3d_torch.mapping.local_map import Keyframe, SparseMap
from v3d_torch.odometry.refine import pixel_sigma


def adjust_locally(sparse_map: SparseMap, keyframe: Keyframe, config: Config, camera: PinholeCamera) -> None:
    """Adjust the keyframes around a new one together with their landmarks, and drop what does not fit.

    Keyframes further off that see the same landmarks take part and stay where they are.

    Args:
        sparse_map: whose keyframes, landmarks and observations are changed in place.
        keyframe: the new one.
        config: size of the neighbourhood, noise.
        camera: intrinsics.
    """
    window = sparse_map.covisible(keyframe.landmarks[keyframe.landmarks >= 0], config.mapping.bundle_keyframes)
    table = sparse_map.observations
    rows = _observations_around(sparse_map, window)
    if len(window) < 2 or len(rows) == 0:
        return
    poses, pose = table["keyframe"][rows].unique(return_inverse=True)
    landmarks, point = table["landmark"][rows].unique(return_inverse=True)
    T_cw = sparse_map.T_cw
    fixed = ~torch.isin(poses, window) | (poses == 0)
    if not fixed.any():
        fixed[0] = True  # the oldest, else the neighbourhood as a whole could drift
    observations = Observations(
        uv=table["uv"][rows],
        inverse_depth=table["inverse_depth"][rows],
        pixel_sigma=pixel_sigma(table["octave"][rows], config.tracking, config.features),
        inverse_depth_sigma=config.tracking.inverse_depth_sigma,
        pose=pose,
        point=point,
    )
    found = bundle_adjust(
        T_cw[poses],
        sparse_map.landmarks["point"][landmarks],
        observations,
        camera,
        fixed,
        config.mapping.bundle_iterations,
        config.mapping.bundle_tolerance,
    )
    # Landmarks with one observation do not take part: they go along with the keyframe that made them.
    T_cw[poses[~fixed]] = rigid(found.T_cw[~fixed])
    sparse_map.move_keyframes(T_cw)
    sparse_map.landmarks["point"][landmarks] = found.points
    sparse_map.forget(rows[found.chi2 > observations.limit])


def _observations_around(sparse_map: SparseMap, window: Tensor) -> Tensor:
    """Rows of all observations of living landmarks that the window sees and that are seen more than once."""
    table = sparse_map.observations
    usable = table["valid"] & sparse_map.landmarks["alive"][table["landmark"]]
    seen = torch.zeros(len(sparse_map.landmarks), dtype=torch.bool)
    seen[table["landmark"][usable & torch.isin(table["keyframe"], window)]] = True
    times = torch.bincount(table["landmark"][usable], minlength=len(sparse_map.landmarks))
    return torch.nonzero(usable & (seen & (times > 1))[table["landmark"]])[:, 0]
