"""Features of a moving rolling-shutter camera."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.odometry.rolling_shutter import Readout

CAMERA = PinholeCamera(525.0, 520.0, 320.0, 240.0)
KINECT = Readout(0.026, 1e8)
VELOCITY = torch.tensor([0.4, -0.3, 0.2, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s
AT_REST = torch.zeros(6, dtype=torch.float64)


def points_in_view(count: int = 200) -> Tensor:
    """Points in the camera's field of view, camera frame, metres, (N, 3)."""
    generator = torch.Generator().manual_seed(3)
    u, v, z = torch.rand(3, count, generator=generator, dtype=torch.float64)
    return CAMERA.back_project(torch.stack([40 + 560 * u, 40 + 400 * v], dim=1), 1 + 3 * z)


def features_of(uv: Tensor, depth: Tensor) -> Features:
    """Features at given positions with equal descriptors, on the finest level."""
    octave = torch.zeros(len(uv), dtype=torch.int64)
    return Features(uv, uv.round().long(), depth, octave, torch.zeros(len(uv), 32, dtype=torch.uint8))


def observe_rolling(points: Tensor, velocity: Tensor, readout: float) -> Features:
    """Features of points observed by a moving rolling-shutter camera, each at the time of its row."""
    moved = points
    for _ in range(20):  # fixed-point iteration: the row of a point depends on where it is observed
        delay = (CAMERA.project(moved)[:, 1].round() / (CAMERA.height - 1) - 0.5) * readout
        T = se3_exp(delay[:, None] * velocity)
        moved = (T[:, :3, :3] @ points[..., None])[..., 0] + T[:, :3, 3]
    return features_of(CAMERA.project(moved), points[:, 2])
