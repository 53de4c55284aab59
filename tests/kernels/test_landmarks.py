"""Kernels of landmark fusion and of moved landmarks give the same results as their twins, also on degenerate inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.sparse_maps import CAMERA, features, make_map, uniform

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.mapping.landmark_fusion import LandmarkFusion
from v3d_torch.mapping.sparse_map import SparseMap

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

COUNTS = [0, 1, 300]


def map_of_two_keyframes(count: int) -> SparseMap:
    """Map of two keyframes with the same descriptors at slightly different pixels and depths, some without depth."""
    sparse_map = make_map()
    first = features(max(count, 1), seed=3)
    sparse_map.insert_keyframe(0, 0.0, torch.eye(4, dtype=torch.float64), first, torch.full((len(first),), -1))
    seen = first[torch.arange(count)]
    depth = torch.where(uniform(count, seed=6) < 0.2, 0.0, seen.depth + 0.05 * uniform(count, seed=7))
    uv = seen.uv + 6 * uniform(2 * count, seed=5).reshape(-1, 2) - 3
    octave = torch.arange(count) % 3
    sigma_ratio = 0.5 + uniform(2 * count, seed=8).reshape(-1, 2)
    seen = Features(uv, seen.pixel, depth, octave, seen.descriptors, sigma_ratio=sigma_ratio)
    T_cw = se3_exp(torch.tensor([0.002, 0, 0, 0, 0.001, 0], dtype=torch.float64))
    sparse_map.insert_keyframe(1, 0.1, T_cw, seen, torch.full((count,), -1))
    return sparse_map


@pytest.mark.parametrize("count", COUNTS)
def test_matches_of_landmark_fusion_equal_their_twin(count: int) -> None:
    sparse_map = map_of_two_keyframes(count)
    sparse_map.landmarks["active"][::7] = False
    sparse_map.landmarks["point"][1::11] = torch.nan
    first, second = sparse_map.keyframes
    first.landmarks[::5] = -1
    fusion = LandmarkFusion(Config(), CAMERA)
    twin = TWINS["v3d_torch.mapping.landmark_fusion.LandmarkFusion._find_matches"]
    for observer, landmarks in ((second, first.landmarks), (first, second.landmarks), (first, first.landmarks)):
        found = twin.compiled(fusion, sparse_map, landmarks, observer)
        assert torch.equal(found, twin.torch(fusion, sparse_map, landmarks, observer))
        assert count < 300 or landmarks is observer.landmarks or 20 < (found >= 0).sum() < 280
    narrow = replace(second, T_cw=second.T_cw.to(torch.float32))
    assert twin.compiled(fusion, sparse_map, first.landmarks, narrow) is NotImplemented


@pytest.mark.parametrize("count", COUNTS)
def test_mergeable_pairs_equal_their_twin(count: int) -> None:
    generator = np.random.default_rng(count)
    ids = generator.permutation(3 * count + 2)
    kept, merged = ids[:count].copy(), ids[count : 2 * count].copy()
    keyframe, landmark = generator.integers(0, 9, 4 * count), generator.integers(0, 3 * count + 2, 4 * count)
    given = kept, merged, keyframe, landmark, generator.random(4 * count) < 0.7, 9, 3 * count + 2
    twin = TWINS["v3d_torch.mapping.landmark_ids._find_mergeable"]
    found, expected = twin.compiled(*given), twin.torch(*given)
    assert all(map(np.array_equal, found, expected))
    assert count < 300 or (0.2 * count < found[0].sum() < count and len(found[1]))


@pytest.mark.parametrize("count", COUNTS)
def test_moved_landmarks_equal_their_twin_to_the_bit(count: int) -> None:
    generator = torch.Generator().manual_seed(count)
    points, directions = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    points[1::5] = torch.nan
    keyframe = torch.randint(0, 6, (count,), generator=generator)
    T_new_old = se3_exp(torch.randn(6, 6, generator=generator, dtype=torch.float64))
    twin = TWINS["v3d_torch.mapping.landmark_motion.move_landmarks"]
    for found, expected in zip(
        twin.compiled(T_new_old, keyframe, points, directions),
        twin.torch(T_new_old, keyframe, points, directions),
        strict=True,
    ):
        assert np.array_equal(found.numpy(), expected.numpy(), equal_nan=True)
    assert twin.compiled(T_new_old.to(torch.float32), keyframe, points, directions) is NotImplemented
