"""Depth re-estimation against Kornia's Gaussian and against a pixel-by-pixel implementation."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from v3d_torch.errors import ConfigError
from v3d_torch.geometry.depth_smoother import DepthSmoother, smooth_depth

DTYPES = [torch.float32, torch.float64]


def stepped_depth(
    height: int, width: int, dtype: torch.dtype = torch.float64, *, batch: int = 2, holes: float = 0.2
) -> Tensor:
    """Depth of two surfaces with a step between them, noise and holes."""
    generator = torch.Generator().manual_seed(0)
    depth = 2 + 0.05 * torch.rand(batch, 1, height, width, generator=generator, dtype=torch.float64)
    depth[..., width // 2 :] += 1.0
    depth[torch.rand(depth.shape, generator=generator) < holes] = 0
    return depth.to(dtype)


def reference_smoothing(depth: np.ndarray, kernel_size: int, sigma: float, edge_ratio: float) -> np.ndarray:
    """The definition, pixel by pixel."""
    radius = kernel_size // 2
    height, width = depth.shape
    out = np.zeros_like(depth)

    def near(z: float, centre: float) -> bool:
        return z > 0 and abs(z - centre) <= edge_ratio * centre

    for v, u in np.argwhere(depth > 0):
        total = weight = 0.0
        for j in range(max(v - radius, 0), min(v + radius + 1, height)):
            for i in range(max(u - radius, 0), min(u + radius + 1, width)):
                if near(depth[j, u], depth[v, u]) and near(depth[j, i], depth[j, u]):
                    g = math.exp(-((i - u) ** 2 + (j - v) ** 2) / (2 * sigma**2)) / (2 * math.pi * sigma**2)
                    total += g * depth[j, i]
                    weight += g
        out[v, u] = total / weight
    return out


@pytest.mark.parametrize(("kernel_size", "sigma", "edge_ratio"), [(5, 1.0, 0.01), (3, 0.7, 0.05), (7, 2.0, 2.0)])
def test_smoothing_equals_its_definition(kernel_size: int, sigma: float, edge_ratio: float) -> None:
    depth = stepped_depth(250, 12)  # taller than two strips
    expected = np.stack([reference_smoothing(image[0].numpy(), kernel_size, sigma, edge_ratio) for image in depth])
    np.testing.assert_allclose(smooth_depth(depth, kernel_size, sigma, edge_ratio)[:, 0].numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
def test_smoothing_without_gates_equals_kornia(dtype: torch.dtype) -> None:
    depth = stepped_depth(260, 40, dtype, holes=0.0)  # taller than two strips
    blur = {"kernel_size": 5, "sigma": (1.0, 1.0), "border_type": "constant"}
    expected = gaussian_blur2d(depth, **blur) / gaussian_blur2d(torch.ones_like(depth), **blur)
    smoothed = smooth_depth(depth, edge_ratio=math.inf)
    assert smoothed.dtype == dtype
    torch.testing.assert_close(smoothed, expected, rtol=2e-6 if dtype == torch.float32 else 1e-12, atol=0.0)


def test_convention_zero_stays_zero_and_is_never_averaged() -> None:
    depth = stepped_depth(30, 40, torch.float32)
    smoothed = smooth_depth(depth, edge_ratio=math.inf)
    assert torch.equal(smoothed == 0, depth == 0)
    assert smoothed[depth > 0].min() >= depth[depth > 0].min()
    assert not smooth_depth(torch.zeros(1, 1, 8, 8)).any()


@pytest.mark.parametrize("missing", [math.nan, math.inf, -math.inf, -1.0])
def test_invalid_depth_counts_as_missing(missing: float) -> None:
    depth = stepped_depth(12, 12)
    broken = torch.where(depth == 0, missing, depth)
    assert torch.equal(smooth_depth(broken), smooth_depth(depth))


def test_smoothing_keeps_depth_edges() -> None:
    depth = torch.full((1, 1, 10, 20), 2.0)
    depth[..., 10:] = 3.0
    assert torch.equal(smooth_depth(depth), depth)
    # A difference of exactly edge_ratio times the centre's depth is still the same surface: 3 - 2 = 0.5 * 2.
    assert (smooth_depth(depth, edge_ratio=0.5)[..., 8:10] > 2).all()
    # The step is half of the nearer depth and a third of the farther: with 0.4, only the far side averages over it.
    assert torch.equal(smooth_depth(depth, edge_ratio=0.4)[..., :10], depth[..., :10])
    assert (smooth_depth(depth, edge_ratio=0.4)[..., 10:12] < 3).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_constant_depth_is_unchanged_to_the_bit(dtype: torch.dtype) -> None:
    depth = torch.full((1, 1, 130, 9), 1.2345, dtype=dtype)
    assert torch.equal(smooth_depth(depth), depth)


def test_smoothing_reduces_noise_on_a_wall() -> None:
    wall = 2 + 0.01 * torch.randn(1, 1, 60, 80, generator=torch.Generator().manual_seed(1))
    assert smooth_depth(wall).std() < 0.35 * wall.std()  # a 5 x 5 Gaussian of sigma 1 leaves 0.28


def test_smoothing_gradcheck() -> None:
    depth = stepped_depth(6, 8, batch=1).requires_grad_()
    # The finite differences must neither cross the gate nor fill a hole.
    measured = torch.where(depth == 0, 0.0, 1.0).detach()
    assert torch.autograd.gradcheck(lambda z: smooth_depth(z * measured, edge_ratio=0.1), (depth,))
    smooth_depth(depth).sum().backward()
    assert depth.grad is not None and depth.grad.isfinite().all()
    assert not depth.grad[depth == 0].any()


def test_module_on_a_batch_equals_the_function_on_each_image() -> None:
    depth = stepped_depth(240, 32, torch.float32, batch=3)
    smoothed = DepthSmoother(kernel_size=3, sigma=0.8, edge_ratio=0.02)(depth)
    each = torch.cat([smooth_depth(image[None], 3, 0.8, 0.02) for image in depth])
    assert torch.equal(smoothed, each)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1, 1, 0, 5), (1, 1, 4, 0), (0, 1, 4, 5)])
def test_image_without_pixels_stays_as_it_is(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    depth = torch.zeros(shape, dtype=dtype)
    smoothed = smooth_depth(depth)
    assert smoothed.shape == shape and smoothed.dtype == dtype


@pytest.mark.parametrize("kernel_size", [0, 4])
def test_even_window_is_rejected(kernel_size: int) -> None:
    with pytest.raises(ConfigError, match=rf"kernel_size is {kernel_size}; .*odd"):
        smooth_depth(torch.ones(1, 1, 4, 4), kernel_size)


def test_real_depth_changes_by_less_than_the_gate(real_sequence: Callable[[str], Path]) -> None:
    path = sorted((real_sequence("fr1_rpy") / "depth").glob("*.png"))[0]
    depth = torch.from_numpy(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 5000)[None, None]
    smoothed = smooth_depth(depth)
    assert torch.equal(smoothed == 0, depth == 0)
    assert ((smoothed - depth).abs() <= 0.05 * depth + 1e-6).all()
