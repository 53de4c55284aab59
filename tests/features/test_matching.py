"""Descriptor matching against OpenCV, kornia-rs and exhaustive search."""

from __future__ import annotations

import cv2
import kornia_rs
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.features.matching import hamming_distance, match_by_projection, match_descriptors
from v3d_torch.kernels.compiler import ENABLED, TWINS


def _descriptors(count: int, seed: int) -> torch.Tensor:
    return torch.randint(0, 256, (count, 32), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def _flip(descriptors: torch.Tensor, bits: int) -> torch.Tensor:
    """Descriptors with the first ``bits`` bits inverted."""
    unpacked = np.unpackbits(descriptors.numpy(), axis=1)
    unpacked[:, :bits] ^= 1
    return torch.from_numpy(np.packbits(unpacked, axis=1))


def _pairs(matches: torch.Tensor) -> torch.Tensor:
    """Pairs (row of a, row of b) of the rows of b that the rows of a match."""
    rows = torch.nonzero(matches >= 0)[:, 0]
    return torch.stack([rows, matches[rows]], dim=1)


def test_hamming_distance_equals_opencv() -> None:
    a, b = _descriptors(50, 0), _descriptors(50, 1)
    expected = [int(cv2.norm(x, y, cv2.NORM_HAMMING)) for x, y in zip(a.numpy(), b.numpy(), strict=True)]
    assert hamming_distance(a, b).tolist() == expected


def test_mutual_matches_equal_opencv_cross_check() -> None:
    a, b = _descriptors(200, 0), _descriptors(200, 1)
    b[:120] = _flip(a[:120], 20)
    pairs = _pairs(match_descriptors(a, b, max_hamming=64, max_ratio=1.0))
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    expected = {(m.queryIdx, m.trainIdx) for m in matcher.match(a.numpy(), b.numpy()) if m.distance <= 64}
    assert {tuple(pair) for pair in pairs.tolist()} == expected
    assert len(expected) == 120


@pytest.mark.parametrize("max_ratio", [0.7, 0.8, 0.95])
def test_matches_with_ratio_test_equal_kornia_rs(max_ratio: float) -> None:
    a, b = _descriptors(200, 0), torch.cat([_descriptors(150, 1), _descriptors(50, 2)])
    b[:120] = _flip(a[:120], 60)
    b[150:] = _flip(b[:50], 20)  # a second candidate with a similar distance
    limits = {"max_distance": 64, "max_ratio": max_ratio, "cross_check": True}
    expected = kornia_rs.features.match_descriptors(a.numpy(), b.numpy(), **limits)
    assert 60 < len(expected) <= 120
    pairs = _pairs(match_descriptors(a, b, max_hamming=64, max_ratio=max_ratio))
    assert torch.equal(pairs, torch.from_numpy(expected))


def test_too_few_descriptors_have_no_matches() -> None:
    for count in ((1, 5), (5, 1)):
        a, b = map(_descriptors, count, (0, 0))
        assert match_descriptors(a, b, max_hamming=64, max_ratio=1.0).tolist() == [-1] * count[0]


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 99), st.integers(0, 30), st.integers(0, 30))
def test_matches_with_padding_are_those_without_it(seed: int, rows: int, columns: int) -> None:
    """Both implementations; many descriptors are equal, so that the first of several nearest ones counts."""
    generator = torch.Generator().manual_seed(seed)
    a, b = (
        torch.randint(0, 4, (2, count, 32), generator=generator, dtype=torch.uint8) // 3 for count in (rows, columns)
    )
    a_valid, b_valid = (torch.rand(each.shape[:2], generator=generator) < 0.7 for each in (a, b))
    limits = {"max_hamming": 40, "max_ratio": 1.0}
    found = match_descriptors(a, b, a_valid, b_valid, **limits)
    twin = TWINS["v3d_torch.features.matching.match_descriptors"]
    if ENABLED:
        assert torch.equal(
            twin.compiled(a, b, a_valid, b_valid, **limits), twin.torch(a, b, a_valid, b_valid, **limits)
        )
    for k in range(2):
        expected = torch.full((rows,), -1)
        pairs = _pairs(match_descriptors(a[k, a_valid[k]], b[k, b_valid[k]], **limits))
        expected[a_valid[k].nonzero()[pairs[:, 0], 0]] = b_valid[k].nonzero()[pairs[:, 1], 0]
        assert torch.equal(found[k], expected)


def _match(projected: torch.Tensor, uv: torch.Tensor, a: torch.Tensor, b: torch.Tensor, **kwargs) -> list[list[int]]:
    levels = kwargs.pop("levels", torch.zeros(len(projected), dtype=torch.int64))
    octave = kwargs.pop("octave", torch.zeros(len(uv), dtype=torch.int64))
    radius = torch.full((len(projected),), 5.0)
    limits = {"max_hamming": 64, "max_ratio": 0.9, **kwargs}
    return match_by_projection(projected, radius, levels, a, uv, octave, b, **limits).tolist()


def test_projection_matching_finds_near_features_with_similar_descriptors() -> None:
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(300, 2, generator=generator, dtype=torch.float64) * 400
    b = _descriptors(300, 1)
    order = torch.randperm(300, generator=generator)
    projected = uv[order] + 2.0
    assert _match(projected, uv, _flip(b[order], 30), b) == [[i, int(j)] for i, j in enumerate(order)]


@given(seed=st.integers(0, 1000), landmarks=st.integers(0, 60), features=st.integers(0, 60), spread=st.floats(1, 300))
@settings(max_examples=60, deadline=None)
def test_projection_matching_equals_exhaustive_search(seed: int, landmarks: int, features: int, spread: float) -> None:
    """Including projections outside the image, and search radii from almost 0 to the whole image."""
    generator = torch.Generator().manual_seed(seed)
    projected = spread * torch.randn(landmarks, 2, generator=generator, dtype=torch.float64)
    uv = 50.0 * torch.randn(features, 2, generator=generator, dtype=torch.float64)
    radius = 100.0 * torch.rand(landmarks, generator=generator, dtype=torch.float64) ** 3
    a, b = _descriptors(landmarks, seed), _descriptors(features, seed + 1)
    levels = torch.zeros(landmarks, dtype=torch.int64)
    octave = torch.zeros(features, dtype=torch.int64)
    pairs = match_by_projection(projected, radius, levels, a, uv, octave, b, max_hamming=256, max_ratio=0.9)
    by_feature: dict[int, list[tuple[int, int]]] = {}
    for i in range(landmarks):
        near = torch.nonzero((uv - projected[i]).norm(dim=1) <= radius[i])[:, 0]
        candidates = sorted((int(hamming_distance(a[i : i + 1], b[j : j + 1])), int(j)) for j in near)
        if candidates and (len(candidates) == 1 or candidates[0][0] <= 0.9 * candidates[1][0]):
            distance, feature = candidates[0]
            by_feature.setdefault(feature, []).append((distance, i))
    assert pairs.tolist() == sorted([min(matches)[1], feature] for feature, matches in by_feature.items())


def test_projection_matching_rejects_far_features_and_other_levels() -> None:
    uv, b = torch.tensor([[10.0, 10.0]]), _descriptors(1, 1)
    assert _match(torch.tensor([[13.0, 14.0]]), uv, b, b) == [[0, 0]]
    assert _match(torch.tensor([[14.0, 14.0]]), uv, b, b) == []
    assert _match(uv, uv, b, b, levels=torch.tensor([2])) == []
    assert _match(uv, uv, b, b, levels=torch.tensor([1])) == [[0, 0]]


def test_landmark_with_two_similar_candidates_is_not_matched() -> None:
    uv = torch.tensor([[10.0, 10.0], [11.0, 10.0]])
    b = _descriptors(1, 1).repeat(2, 1)
    assert _match(uv[:1], uv, _flip(b[:1], 10), b) == []
    assert _match(uv[:1], uv, _flip(b[:1], 10), torch.cat([b[:1], _flip(b[:1], 60)])) == [[0, 0]]


def test_feature_is_matched_to_the_landmark_with_the_smallest_distance() -> None:
    uv, b = torch.tensor([[10.0, 10.0]]), _descriptors(1, 1)
    landmarks = torch.cat([_flip(b, 20), _flip(b, 5), _flip(b, 40)])
    assert _match(uv.repeat(3, 1), uv, landmarks, b) == [[1, 0]]


def test_projection_matching_of_nothing_is_empty() -> None:
    none = torch.zeros(0, 2)
    assert _match(none, torch.zeros(3, 2), _descriptors(0, 0), _descriptors(3, 1)) == []
    assert _match(torch.zeros(3, 2), none, _descriptors(3, 0), _descriptors(0, 1)) == []
