"""Kernels of descriptor matching give the same pairs as their twins, also on degenerate inputs."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from v3d_torch.features import matching, projection_search
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

EXHAUSTIVE = TWINS[f"{matching.__name__}.match_descriptors"]
NEAR = TWINS[f"{projection_search.__name__}.match_by_projection"]


def descriptors(count: int, seed: int, distinct: int = 40, noise: float = 0.03) -> Tensor:
    """Noisy copies of few descriptors, so that ties and second-best matches occur."""
    generator = torch.Generator().manual_seed(seed)
    originals = torch.randint(0, 256, (distinct, 32), generator=torch.Generator().manual_seed(0))
    flipped = (torch.rand(count, 32, 8, generator=generator) < noise) * (2 ** torch.arange(8))
    chosen = originals[torch.randint(0, distinct, (count,), generator=generator)]
    return (chosen ^ flipped.sum(dim=2)).to(torch.uint8)


def assert_equal(twin: compiler.Twin, *args: Any, **kwargs: Any) -> Tensor:
    found, expected = twin.compiled(*args, **kwargs), twin.torch(*args, **kwargs)
    assert found.dtype == expected.dtype and found.shape == expected.shape
    assert torch.equal(found, expected)
    return expected


@pytest.mark.parametrize("counts", [(0, 0), (0, 5), (1, 9), (9, 1), (2, 2), (30, 200), (200, 30), (150, 150)])
@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("max_ratio", [0.8, 1.0])
def test_exhaustive_matching_equals_its_twin(counts: tuple[int, int], noise: float, max_ratio: float) -> None:
    a, b = descriptors(counts[0], 1, noise=noise), descriptors(counts[1], 2, noise=noise)
    assert_equal(EXHAUSTIVE, a, b, max_hamming=64, max_ratio=max_ratio)


def test_exhaustive_matching_finds_pairs() -> None:
    a, b = descriptors(20, 1, distinct=2000), descriptors(25, 1, distinct=2000)[:20]
    assert len(assert_equal(EXHAUSTIVE, a, b, max_hamming=256, max_ratio=1.0)) > 0


@pytest.mark.parametrize("landmarks", [0, 1, 200])
@pytest.mark.parametrize("features", [0, 1, 2, 300])
@pytest.mark.parametrize("radius", [0.0, 3.0, 40.0, 1000.0])
def test_projection_matching_equals_its_twin(landmarks: int, features: int, radius: float) -> None:
    generator = torch.Generator().manual_seed(landmarks + features)
    size = torch.tensor([80.0, 60.0], dtype=torch.float64)
    uv = torch.rand(features, 2, generator=generator, dtype=torch.float64) * size
    projected = torch.rand(landmarks, 2, generator=generator, dtype=torch.float64) * 3 * size - size
    if landmarks and features:
        projected[0] = uv[0]
    if landmarks > 1:
        projected[1] = torch.nan
    landmark_octave, octave = (torch.randint(0, 4, (count,), generator=generator) for count in (landmarks, features))
    pairs = assert_equal(
        NEAR,
        projected,
        torch.full((landmarks,), radius, dtype=torch.float64),
        landmark_octave,
        descriptors(landmarks, 3),
        uv,
        octave,
        descriptors(features, 4),
        max_hamming=64,
        max_ratio=0.9,
    )
    assert len(pairs) or not (landmarks > 1 and features > 2 and radius == 40)


def test_projection_matching_of_features_at_one_pixel_equals_its_twin() -> None:
    pixels = torch.full((20, 2), 7.0, dtype=torch.float64)
    octave, radius = torch.zeros(20, dtype=torch.int64), torch.ones(20, dtype=torch.float64)
    args = pixels, radius, octave, descriptors(20, 5), pixels, octave, descriptors(20, 6)
    assert_equal(NEAR, *args, max_hamming=64, max_ratio=1.0)
