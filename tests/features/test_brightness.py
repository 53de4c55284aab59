"""Brightening of dark images."""

from __future__ import annotations

import pytest
import torch
from helpers.photographs import photograph

from v3d_torch.config import FeaturesConfig
from v3d_torch.features.brightness import brighten
from v3d_torch.features.orb import ORB
from v3d_torch.geometry.camera import PinholeCamera


def test_only_dark_images_are_brightened() -> None:
    image = photograph("coffee")
    assert brighten(image) is image
    dark = (image * 0.3).to(torch.uint8)
    assert brighten(dark).float().mean() == pytest.approx(64, abs=2)
    darker = (image * 0.04).to(torch.uint8)
    assert torch.equal(brighten(darker), darker * 4)
    assert not brighten(torch.zeros(3, 20, 20, dtype=torch.uint8)).any()


def test_brightened_pixels_do_not_overflow() -> None:
    image = torch.zeros(3, 64, 64, dtype=torch.uint8)
    image[:, :8, :8] = 200
    assert brighten(image).max() == 255 and not brighten(image)[:, 9:, 9:].any()


def test_features_of_a_dark_image_are_those_of_a_bright_one() -> None:
    """Without brightening, a quarter of the corners is found, because few differences exceed the threshold."""
    image = photograph("coffee")
    height, width = image.shape[1:]
    camera = PinholeCamera(fx=500, fy=500, cx=width / 2, cy=height / 2, width=width, height=height)
    detect, depth = ORB(FeaturesConfig(count=1000), camera), torch.ones(1, height, width)
    bright, dark = (detect(each, depth) for each in (image, (image * 0.1).to(torch.uint8)))
    distance = torch.cdist(bright.uv, dark.uv).amin(dim=1)
    assert (distance < 2).float().mean() > 0.7
