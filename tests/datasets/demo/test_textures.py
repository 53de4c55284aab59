"""Textures: sampling of the atlas, baked lighting, and procedural materials."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from v3d_torch.datasets.demo import materials
from v3d_torch.datasets.demo.lighting import bake_lighting
from v3d_torch.datasets.demo.scene import Box, Rectangle
from v3d_torch.datasets.demo.texture_atlas import TextureAtlas


def test_sampling_equals_grid_sample() -> None:
    """Compare with the bilinear interpolation of torch at full resolution."""
    rng = np.random.default_rng(0)
    textures = [rng.random((37, 53, 3), np.float32), rng.random((16, 90, 3), np.float32)]
    s, t = torch.rand(2, 500, generator=torch.Generator().manual_seed(1))
    surface = torch.arange(500, dtype=torch.int32) % 2
    sampled = TextureAtlas(textures, [100.0, 100.0])(surface, s, t, torch.full((500,), 0.01))
    grid = torch.stack([2 * s - 1, 2 * t - 1], -1)[None, None]
    for i, texture in enumerate(textures):
        image = torch.from_numpy(texture).permute(2, 0, 1)[None]
        expected = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=False)[0, :, 0].T
        assert torch.allclose(sampled[surface == i], expected[surface == i], atol=2e-3)


def test_distant_texture_is_averaged() -> None:
    checker = np.indices((64, 64)).sum(0)[..., None] % 2 * np.ones(3, np.float32)
    colour = TextureAtlas([checker.astype(np.float32)], [64.0])(
        torch.zeros(9, dtype=torch.int32), torch.rand(9), torch.rand(9), torch.full((9,), 0.1)
    )
    assert torch.allclose(colour, torch.tensor(0.5), atol=1e-5)


def test_box_casts_a_shadow() -> None:
    floor = Rectangle((-2.0, 4.0, 0.0), (4.0, 0, 0), (0, -4.0, 0), np.ones((64, 64, 3), np.float32))
    room = ((-2.0, 0.0, 0.0), (2.0, 4.0, 2.7))
    table = Box((-0.5, 1.5, 0.4), (0.5, 2.5, 0.5))
    shadowed = bake_lighting([floor], [table], *room, seed=0)[0].texture
    lit = bake_lighting([floor], [Box((9.0, 9.0, 9.0), (9.1, 9.1, 9.1))], *room, seed=0)[0].texture
    assert shadowed[32, 32, 0] < 0.8 * lit[32, 32, 0]
    assert shadowed[2, 2, 0] == pytest.approx(lit[2, 2, 0], rel=0.02)


def test_bricks_have_many_corners() -> None:
    rng = np.random.default_rng(0)
    wall = materials.bricks(rng, 1.0, 0.5, 200, (0.7, 0.4, 0.3))
    assert wall.shape == (100, 200, 3) and wall.dtype == np.float32
    assert wall.min() >= 0.0 and wall.max() <= 1.0
    corners = cv2.goodFeaturesToTrack(cv2.cvtColor(wall, cv2.COLOR_RGB2GRAY), 500, 0.05, 3)
    assert len(corners) > 50
