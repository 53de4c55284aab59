"""ORB detection on synthetic images and photographs."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import kornia_rs
import numpy as np
import pytest
import torch
from helpers.photographs import photograph

from v3d_torch.config import Config, FeaturesConfig
from v3d_torch.features.features import Features
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


def test_most_features_lie_beside_those_of_kornia_rs() -> None:
    """kornia-rs selects several pixels of a corner, and no corners with little contrast."""
    image = photograph("coffee")
    height, width = image.shape[1:]
    camera = PinholeCamera(500.0, 500.0, width / 2, height / 2, width, height)
    features = ORB(FeaturesConfig(count=1500), camera)(image, torch.ones(1, height, width))
    orb = kornia_rs.features.orb_detect_and_compute(image.permute(1, 2, 0).contiguous().numpy(), n_keypoints=1500)
    for octave in range(8):
        scale = 1.2**octave
        ours = (features.uv[features.octave == octave] + 0.5) / scale - 0.5
        theirs = torch.from_numpy(orb.keypoints_xy[orb.octaves == octave] / scale).to(torch.float64)
        assert (torch.cdist(theirs, ours).amin(dim=1) < 2).to(torch.float64).mean() > 0.5


@pytest.mark.parametrize(("scale", "first_octave"), [(1, 0), (3, 4)])
def test_features_of_all_levels_lie_at_the_same_point(scale: int, first_octave: int) -> None:
    """A level's pixel covers a square of the image; its centre is not the corner's pixel times the scale."""
    width, height = 640 * scale, 480 * scale
    image = torch.full((3, height, width), 60, dtype=torch.uint8)
    image[:, 200:, 300:] = 200  # its corner lies between pixels 299 and 300, and 199 and 200
    camera = PinholeCamera(500.0 * scale, 500.0 * scale, (width - 1) / 2, (height - 1) / 2, width, height)
    features = ORB(Config().features, camera)(image, torch.ones(1, height, width))
    octaves = features.octave.unique()
    assert len(octaves) >= 6 and octaves[0] == first_octave
    for octave in octaves.tolist():
        # FAST finds corners inside of the bright quarter, at the same distance in pixels of each level.
        inside = (features.uv[features.octave == octave] - torch.tensor([299.5, 199.5])) / 1.2**octave
        assert (inside[:, 0] - inside[:, 1]).abs().max() < 3.5
        assert inside.abs().max() < 4.5


def test_positions_are_accurate_to_a_fraction_of_a_pixel() -> None:
    """Two images of half the size, blurred as by a lens, whose pixels lie half a pixel apart."""
    photo = cv2.GaussianBlur(photograph("coffee").permute(1, 2, 0).numpy(), (0, 0), 2.0)
    height, width = (size // 2 - 1 for size in photo.shape[:2])
    orb = ORB(FeaturesConfig(count=1000), PinholeCamera(500.0, 500.0, width / 2, height / 2, width, height))
    first, second = (
        orb(
            torch.from_numpy(
                cv2.resize(
                    photo[start : start + 2 * height, start : start + 2 * width],
                    (width, height),
                    interpolation=cv2.INTER_AREA,
                )
            ).permute(2, 0, 1),
            torch.ones(1, height, width),
        )
        for start in (0, 1)
    )
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(
        first.descriptors.numpy(), second.descriptors.numpy()
    )
    i, j = torch.tensor([(each.queryIdx, each.trainIdx) for each in matches]).T
    finest = (first.octave[i] == 0) & (second.octave[j] == 0)
    i, j = i[finest], j[finest]

    def median_error(position: Callable[[Features], torch.Tensor]) -> float:
        return float((position(first)[i] - position(second)[j] - 0.5).norm(dim=1).median())

    assert len(i) > 100
    assert median_error(lambda features: features.uv) < 0.6 * median_error(lambda features: features.pixel.double())


def test_features_are_found_at_low_contrast() -> None:
    blocks = _random_blocks().to(torch.float32)
    dim = (100 + blocks * 19 / 255).to(torch.uint8)  # all differences are below the first threshold
    assert len(ORB(Config().features, CAMERA)(dim, torch.ones(1, 480, 640))) > 300
