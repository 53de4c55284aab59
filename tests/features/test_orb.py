"""ORB detection on a synthetic image."""

from __future__ import annotations

import numpy as np
import torch

from v3d_torch.config import Config
from v3d_torch.features.orb import ORB
from v3d_torch.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(500.0, 500.0, 319.5, 239.5)


def _random_blocks() -> torch.Tensor:
    generator = np.random.default_rng(0)
    blocks = generator.integers(0, 255, (3, 24, 32), dtype=np.uint8)
    return torch.from_numpy(blocks.repeat(20, axis=1).repeat(20, axis=2))


def test_features_have_the_depth_of_their_pixel() -> None:
    depth = torch.arange(480 * 640, dtype=torch.float32).reshape(1, 480, 640) / 1e5 + 1
    features = ORB(Config().features, CAMERA)(_random_blocks(), depth)
    assert len(features) > 500
    u, v = features.pixel.unbind(dim=1)
    assert torch.equal(features.depth, depth[0, v, u].double())
    assert (features.octave.unique() == torch.arange(8)).all()
    assert torch.allclose(features.inverse_depth * features.depth, torch.ones(len(features), dtype=torch.float64))


def test_features_beyond_max_depth_have_no_depth() -> None:
    features = ORB(Config().features, CAMERA)(_random_blocks(), torch.full((1, 480, 640), 9.0))
    assert len(features) > 500
    assert (features.depth == 0).all()
    assert (features.inverse_depth == 0).all()


def test_blank_image_has_no_features() -> None:
    features = ORB(Config().features, CAMERA)(torch.zeros(3, 480, 640, dtype=torch.uint8), torch.ones(1, 480, 640))
    assert len(features) == 0


def test_in_mask_selects_features_by_their_pixel() -> None:
    features = ORB(Config().features, CAMERA)(_random_blocks(), torch.ones(1, 480, 640))
    mask = torch.zeros(480, 640, dtype=torch.bool)
    mask[:, :320] = True
    assert torch.equal(features.in_mask(mask), features.pixel[:, 0] < 320)
