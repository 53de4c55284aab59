"""Sparse maps and features made by hand."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import Config, MappingConfig
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.sparse_map import SparseMap

CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5)


EYE = torch.eye(4, dtype=torch.float64)


def numbers(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def features(count: int, seed: int = 0, depth: float | None = None) -> Features:
    """Features all over the image, 1 to 3 m away or at the given depth."""
    uv = numbers(count, 2, seed=seed) * torch.tensor([639.0, 479.0], dtype=torch.float64)
    bits = torch.randint(0, 256, (count, 32), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)
    z = 1 + 2 * numbers(count, seed=seed + 1) if depth is None else torch.full((count,), depth, dtype=torch.float64)
    return Features(uv, uv.round().long(), z, (4 * numbers(count, seed=seed + 2)).long(), bits)


def sparse_map(**settings_: int) -> SparseMap:
    config = Config()
    return SparseMap(MappingConfig(**settings_), config.features, CAMERA)
