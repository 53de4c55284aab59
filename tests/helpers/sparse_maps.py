"""Synthetic features and empty sparse maps."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import Config, MappingConfig
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.sparse_map import SparseMap

CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5)

EYE = torch.eye(4, dtype=torch.float64)


def uniform(*shape: int, seed: int) -> Tensor:
    """Random numbers in [0, 1), float64."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def features(count: int, seed: int = 0, depth: float | None = None) -> Features:
    """Features spread over the image, at 1 to 3 m or at the given depth, metres."""
    uv = uniform(count, 2, seed=seed) * torch.tensor([639.0, 479.0], dtype=torch.float64)
    bits = torch.randint(0, 256, (count, 32), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)
    z = 1 + 2 * uniform(count, seed=seed + 1) if depth is None else torch.full((count,), depth, dtype=torch.float64)
    return Features(uv, uv.round().long(), z, (4 * uniform(count, seed=seed + 2)).long(), bits)


def no_features() -> Features:
    """Features of an image without any."""
    none = torch.zeros(0, dtype=torch.int64)
    return Features(torch.zeros(0, 2), torch.zeros(0, 2).long(), none.double(), none, torch.zeros(0, 32).byte())


def make_map(**settings: int) -> SparseMap:
    """An empty map with the given mapping configuration."""
    config = Config()
    return SparseMap(MappingConfig(**settings), config.features, CAMERA)
