"""Oriented BRIEF descriptors, compared with those of kornia-rs and between both implementations."""

from __future__ import annotations

import kornia_rs
import numpy as np
import pytest
import torch
from helpers.photographs import photograph
from torch import Tensor

from v3d_torch.features.brief import MARGIN, describe
from v3d_torch.kernels.compiler import ENABLED, TWINS

NAMES = ("astronaut", "cat", "rocket")


def grey(name: str) -> tuple[Tensor, Tensor]:
    """Grey photograph, and smoothed as for the comparisons; uint8, (H, W)."""
    image = kornia_rs.imgproc.gray_from_rgb(photograph(name).permute(1, 2, 0).contiguous().numpy())
    smoothed = kornia_rs.imgproc.gaussian_blur(image, (7, 7), (2.0, 2.0))
    return torch.from_numpy(image[..., 0]), torch.from_numpy(smoothed[..., 0])


def random_corners(image: Tensor, count: int, margin: int = MARGIN) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    height, width = image.shape
    return torch.stack(
        [torch.randint(margin, size - margin, (count,), generator=generator) for size in (width, height)], dim=1
    )


@pytest.mark.parametrize("name", NAMES)
def test_descriptors_equal_those_of_kornia_rs(name: str) -> None:
    image, smoothed = grey(name)
    orb = kornia_rs.features.orb_detect_and_compute(image.numpy(), n_keypoints=500, n_scales=1)
    corners = torch.from_numpy(orb.keypoints_xy.astype(np.int64))
    inside = ((corners >= MARGIN) & (corners < torch.tensor(image.shape).flip(0) - MARGIN)).all(dim=1)
    assert inside.sum() > 300
    expected = torch.from_numpy(orb.descriptors.reshape(-1, 32))[inside]
    assert torch.equal(describe(image, smoothed, corners[inside]), expected)


@pytest.mark.skipif(not ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [0, 1, 400])
def test_kernel_equals_its_twin(name: str, count: int) -> None:
    image, smoothed = grey(name)
    corners = random_corners(image, count)
    expected = TWINS["v3d_torch.features.brief.describe"].torch(image, smoothed, corners)
    assert torch.equal(describe(image, smoothed, corners), expected)
    assert expected.shape == (count, 32)


def test_descriptors_turn_with_the_image() -> None:
    image, smoothed = grey("cat")
    corners = random_corners(image, 200, 60)
    # A quarter turn moves the pixel (x, y) to (height - 1 - y, x).
    turned = [torch.rot90(each, -1).contiguous() for each in (image, smoothed)]
    turned_corners = torch.stack([image.shape[0] - 1 - corners[:, 1], corners[:, 0]], dim=1)
    assert torch.equal(turned[0][turned_corners[:, 1], turned_corners[:, 0]], image[corners[:, 1], corners[:, 0]])
    different = describe(image, smoothed, corners) ^ describe(turned[0], turned[1], turned_corners)
    bits = np.unpackbits(different.numpy(), axis=1).sum(axis=1)
    assert bits.mean() < 8  # rounding of the test points; unrelated descriptors differ in 128 bits


def test_blank_image_has_empty_descriptors() -> None:
    blank = torch.zeros(64, 64, dtype=torch.uint8)
    assert (describe(blank, blank, torch.tensor([[32, 32]])) == 0).all()
