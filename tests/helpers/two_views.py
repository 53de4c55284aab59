"""Features of the same points in two views with a known motion between them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(500.0, 500.0, 319.5, 239.5)


def known_motion(angle: float = 0.05) -> Tensor:
    """Motion ``T_ba``: a rotation about the y axis by ``angle`` radians, and a translation."""
    T = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(angle), math.sin(angle)
    T[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    T[:3, 3] = torch.tensor([0.05, -0.02, 0.03])
    return T


def two_views(outliers: int = 0, noise: float = 0.0) -> tuple[Features, Features, Tensor]:
    """Features of 400 points in views a and b, and ``T_ba``; the last ``outliers`` are displaced in view b."""
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(400, 2, generator=generator, dtype=torch.float64) * torch.tensor([520.0, 400.0]) + 40
    z = torch.rand(400, generator=generator, dtype=torch.float64) * 3 + 1
    T_ba = known_motion()
    points = CAMERA.back_project(uv, z) @ T_ba[:3, :3].T + T_ba[:3, 3]
    projected = CAMERA.project(points)
    projected = projected + noise * torch.randn(400, 2, generator=generator, dtype=torch.float64)
    if outliers:
        projected[-outliers:] += 30 + 60 * torch.rand(outliers, 2, generator=generator, dtype=torch.float64)
    descriptors = torch.randint(0, 256, (400, 32), generator=generator, dtype=torch.uint8)
    octave = torch.zeros(400, dtype=torch.int64)

    def features(uv: Tensor, z: Tensor) -> Features:
        return Features(uv, uv.round().long(), z, octave, descriptors)

    return features(uv, z), features(projected, points[:, 2]), T_ba
