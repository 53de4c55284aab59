"""The kernel of the depth smoother against its torch twin on random and degenerate images."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

TWIN = TWINS[f"{smooth_depth.__module__}.smooth_depth"]


def noisy_depth(height: int, width: int, holes: float) -> Tensor:
    """Depth of two surfaces with noise, holes, and values that are no depth."""
    generator = torch.Generator().manual_seed(height * width)
    depth = 2 + 0.1 * torch.rand(1, 1, height, width, generator=generator)
    depth[..., width // 2 :] += 1
    kind = torch.rand(depth.shape, generator=generator)
    depth[kind < holes] = 0
    for k, value in enumerate((math.nan, math.inf, -1.0, 2e5, 1e-30)):
        depth[(kind > 0.9 + 0.02 * k) & (kind < 0.902 + 0.02 * k)] = value
    return depth


@pytest.mark.parametrize("edge_ratio", [0.0, 0.03, 2.0, math.inf])
@pytest.mark.parametrize("kernel_size", [1, 3, 5, 9])
@pytest.mark.parametrize("size", [(130, 121), (5, 64), (2, 3), (1, 1), (1, 40), (40, 1)])
def test_smoothing_equals_its_twin(size: tuple[int, int], kernel_size: int, edge_ratio: float) -> None:
    for holes in (0.0, 0.2, 1.0):
        depth = noisy_depth(*size, holes)
        before = depth.clone()
        found = TWIN.compiled(depth, kernel_size, 1.2, edge_ratio)
        expected = TWIN.torch(depth, kernel_size, 1.2, edge_ratio)
        torch.testing.assert_close(found, expected, rtol=3e-7, atol=0)
        assert torch.equal(found > 0, expected > 0)
        assert torch.equal(depth.nan_to_num(), before.nan_to_num())


def test_part_of_an_image_is_smoothed_like_a_copy() -> None:
    depth = noisy_depth(60, 80, 0.1)[..., 7:51, ::2]
    assert torch.equal(TWIN.compiled(depth), TWIN.compiled(depth.clone()))


@pytest.mark.parametrize("shape", [(1, 2, 8, 8), (8, 8)])
def test_other_shapes_are_left_to_torch(shape: tuple[int, ...]) -> None:
    assert TWIN.compiled(torch.ones(shape)) is NotImplemented
    assert TWIN.compiled(torch.ones(1, 1, 8, 8, dtype=torch.float64)) is NotImplemented
    assert TWIN.compiled(torch.ones(1, 1, 8, 8), kernel_size=4) is NotImplemented
