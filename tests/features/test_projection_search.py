"""Matching of landmarks to the features near their projections."""

from __future__ import annotations

import torch
from helpers.random_descriptors import invert_bits, random_descriptors
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.features.matching import hamming_distance
from v3d_torch.features.projection_search import match_by_projection


def _match(projected: torch.Tensor, uv: torch.Tensor, a: torch.Tensor, b: torch.Tensor, **kwargs) -> list[list[int]]:
    landmark_octave = kwargs.pop("landmark_octave", torch.zeros(len(projected), dtype=torch.int64))
    octave = kwargs.pop("octave", torch.zeros(len(uv), dtype=torch.int64))
    radius = torch.full((len(projected),), 5.0)
    limits = {"max_hamming": 64, "max_ratio": 0.9, **kwargs}
    return match_by_projection(projected, radius, landmark_octave, a, uv, octave, b, **limits).tolist()


def test_projection_matching_finds_near_features_with_similar_descriptors() -> None:
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(300, 2, generator=generator, dtype=torch.float64) * 400
    b = random_descriptors(300, 1)
    order = torch.randperm(300, generator=generator)
    projected = uv[order] + 2.0
    assert _match(projected, uv, invert_bits(b[order], 30), b) == [[i, int(j)] for i, j in enumerate(order)]


@given(seed=st.integers(0, 1000), landmarks=st.integers(0, 60), features=st.integers(0, 60), spread=st.floats(1, 300))
@settings(max_examples=60)
def test_projection_matching_equals_exhaustive_search(seed: int, landmarks: int, features: int, spread: float) -> None:
    """Including projections outside the image, and search radii from almost 0 to the whole image."""
    generator = torch.Generator().manual_seed(seed)
    projected = spread * torch.randn(landmarks, 2, generator=generator, dtype=torch.float64)
    uv = 50.0 * torch.randn(features, 2, generator=generator, dtype=torch.float64)
    radius = 100.0 * torch.rand(landmarks, generator=generator, dtype=torch.float64) ** 3
    a, b = random_descriptors(landmarks, seed), random_descriptors(features, seed + 1)
    landmark_octave = torch.zeros(landmarks, dtype=torch.int64)
    octave = torch.zeros(features, dtype=torch.int64)
    pairs = match_by_projection(projected, radius, landmark_octave, a, uv, octave, b, max_hamming=256, max_ratio=0.9)
    by_feature: dict[int, list[tuple[int, int]]] = {}
    for i in range(landmarks):
        near = torch.nonzero((uv - projected[i]).norm(dim=1) <= radius[i])[:, 0]
        candidates = sorted((int(hamming_distance(a[i : i + 1], b[j : j + 1])), int(j)) for j in near)
        if candidates and (len(candidates) == 1 or candidates[0][0] <= 0.9 * candidates[1][0]):
            distance, feature = candidates[0]
            by_feature.setdefault(feature, []).append((distance, i))
    assert pairs.tolist() == sorted([min(matches)[1], feature] for feature, matches in by_feature.items())


def test_projection_matching_rejects_far_features_and_other_levels() -> None:
    uv, b = torch.tensor([[10.0, 10.0]]), random_descriptors(1, 1)
    assert _match(torch.tensor([[13.0, 14.0]]), uv, b, b) == [[0, 0]]
    assert _match(torch.tensor([[14.0, 14.0]]), uv, b, b) == []
    assert _match(uv, uv, b, b, landmark_octave=torch.tensor([2])) == []
    assert _match(uv, uv, b, b, landmark_octave=torch.tensor([1])) == [[0, 0]]


def test_landmark_with_two_similar_candidates_is_not_matched() -> None:
    uv = torch.tensor([[10.0, 10.0], [11.0, 10.0]])
    b = random_descriptors(1, 1).repeat(2, 1)
    assert _match(uv[:1], uv, invert_bits(b[:1], 10), b) == []
    assert _match(uv[:1], uv, invert_bits(b[:1], 10), torch.cat([b[:1], invert_bits(b[:1], 60)])) == [[0, 0]]


def test_feature_is_matched_to_the_landmark_with_the_smallest_distance() -> None:
    uv, b = torch.tensor([[10.0, 10.0]]), random_descriptors(1, 1)
    landmarks = torch.cat([invert_bits(b, 20), invert_bits(b, 5), invert_bits(b, 40)])
    assert _match(uv.repeat(3, 1), uv, landmarks, b) == [[1, 0]]


def test_projection_matching_of_nothing_is_empty() -> None:
    none = torch.zeros(0, 2)
    assert _match(none, torch.zeros(3, 2), random_descriptors(0, 0), random_descriptors(3, 1)) == []
    assert _match(torch.zeros(3, 2), none, random_descriptors(3, 0), random_descriptors(0, 1)) == []
