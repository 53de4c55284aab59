"""Exhaustive matching of descriptors."""

from __future__ import annotations

import math

import cv2
import kornia_rs
import numpy as np
import pytest
import torch
from helpers import camera_inputs
from helpers.random_descriptors import invert_bits, random_descriptors
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.features.matching import hamming_distance, match_descriptors
from v3d_torch.kernels.compiler import ENABLED, TWINS


def _pairs(matches: torch.Tensor) -> torch.Tensor:
    """Pairs (row of a, row of b) of the rows of b that the rows of a match."""
    rows = torch.nonzero(matches >= 0)[:, 0]
    return torch.stack([rows, matches[rows]], dim=1)


def test_hamming_distance_equals_opencv() -> None:
    a, b = random_descriptors(50, 0), random_descriptors(50, 1)
    expected = [int(cv2.norm(x, y, cv2.NORM_HAMMING)) for x, y in zip(a.numpy(), b.numpy(), strict=True)]
    assert hamming_distance(a, b).tolist() == expected


def test_mutual_matches_equal_opencv_cross_check() -> None:
    a, b = random_descriptors(200, 0), random_descriptors(200, 1)
    b[:120] = invert_bits(a[:120], 20)
    pairs = _pairs(match_descriptors(a, b, max_hamming=64, max_ratio=1.0))
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    expected = {(m.queryIdx, m.trainIdx) for m in matcher.match(a.numpy(), b.numpy()) if m.distance <= 64}
    assert {tuple(pair) for pair in pairs.tolist()} == expected
    assert len(expected) == 120


@pytest.mark.parametrize("max_ratio", [0.7, 0.8, 0.95])
def test_matches_with_ratio_test_equal_kornia_rs(max_ratio: float) -> None:
    a, b = random_descriptors(200, 0), torch.cat([random_descriptors(150, 1), random_descriptors(50, 2)])
    b[:120] = invert_bits(a[:120], 60)
    b[150:] = invert_bits(b[:50], 20)  # a second candidate with a similar distance
    limits = {"max_distance": 64, "max_ratio": max_ratio, "cross_check": True}
    expected = kornia_rs.features.match_descriptors(a.numpy(), b.numpy(), **limits)
    assert 60 < len(expected) <= 120
    pairs = _pairs(match_descriptors(a, b, max_hamming=64, max_ratio=max_ratio))
    assert torch.equal(pairs, torch.from_numpy(expected))


@pytest.mark.parametrize(("a", "b"), [((4, 32), (4, 16)), ((4, 16), (4, 32)), ((32,), (32,)), ((4, 32), (32,))])
def test_wrong_shapes_are_rejected(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError):
        match_descriptors(*(torch.zeros(shape, dtype=torch.uint8) for shape in (a, b)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
@pytest.mark.parametrize("name", ["a", "b"])
def test_descriptors_that_are_not_bytes_are_rejected(name: str, dtype: torch.dtype) -> None:
    inputs = {"a": random_descriptors(5, 0), "b": random_descriptors(5, 0)}
    with pytest.raises(
        InputError, match=rf"^{name} has the type {dtype}; give binary descriptors of type torch\.uint8$"
    ):
        match_descriptors(**inputs | {name: 1000 * inputs[name].to(dtype)})


def test_too_few_descriptors_have_no_matches() -> None:
    for count in ((1, 5), (5, 1)):
        a, b = map(random_descriptors, count, (0, 0))
        assert match_descriptors(a, b, max_hamming=64, max_ratio=1.0).tolist() == [-1] * count[0]


@pytest.mark.parametrize("count", [0, 30])
@pytest.mark.parametrize("name", ["a", "b", "a_valid", "b_valid"])
def test_any_input_can_have_batch_dimensions(name: str, count: int) -> None:
    """Both implementations, and inputs of which others have fewer batch dimensions."""
    inputs = camera_inputs.descriptors(3, count, torch.float64)
    several = {key: each if key == name else each[0] for key, each in inputs.items()}
    expected = [match_descriptors(**several | {name: each}) for each in inputs[name]]
    twin = TWINS["v3d_torch.features.matching.match_descriptors"]
    for match in twin if ENABLED else (twin.torch,):
        assert torch.equal(match(**several), torch.stack(expected))
        nested = match(**several | {"a_valid": several["a_valid"].expand(2, 3, count)})
        assert torch.equal(nested, torch.stack(expected).expand(2, 3, count))


def test_ratio_test_of_both_implementations_is_exact() -> None:
    """Distances of 3 and 5 bits to 51 and 85 bits, with a maximum ratio that is theirs up to rounding."""
    twin = TWINS["v3d_torch.features.matching.match_descriptors"]
    for scale in range(1, 18):
        a, b = torch.zeros(2, 32, dtype=torch.uint8), torch.zeros(2, 32, dtype=torch.uint8)
        a[1] = 255
        for row, bits in ((0, 3 * scale), (1, 5 * scale)):
            b[row] = torch.from_numpy(np.packbits(np.arange(256) < bits))
        for ratio in (3 / 5, np.nextafter(3 / 5, 0), np.nextafter(3 / 5, 1)):
            expected = [0 if 3 * scale < ratio * (5 * scale) else -1, -1]
            for match in twin if ENABLED else (twin.torch,):
                assert match(a, b, max_hamming=256, max_ratio=float(ratio)).tolist() == expected


def test_wide_descriptors_inside_autocast_match_as_outside() -> None:
    """Scalar products above 256 are not exact in bfloat16."""
    a = random_descriptors(120, 0).reshape(30, 128)
    b = torch.cat([invert_bits(a, 21), invert_bits(a, 20)])
    with torch.autocast("cpu", torch.bfloat16):
        assert match_descriptors(a, b, max_hamming=64, max_ratio=0.99).tolist() == list(range(30, 60))


@settings(max_examples=30)
@given(st.integers(0, 99), st.integers(0, 30), st.integers(0, 30), st.sampled_from([(40, 1.0), (300, 1.5)]))
def test_matches_with_padding_are_those_without_it(
    seed: int, rows: int, columns: int, thresholds: tuple[int, float]
) -> None:
    """Both implementations; many descriptors are equal, so that the first of several nearest ones counts.

    The second thresholds accept any nearest neighbour.
    """
    generator = torch.Generator().manual_seed(seed)
    a, b = (
        torch.randint(0, 4, (2, count, 32), generator=generator, dtype=torch.uint8) // 3 for count in (rows, columns)
    )
    a_valid, b_valid = (torch.rand(each.shape[:2], generator=generator) < 0.7 for each in (a, b))
    limits = {"max_hamming": thresholds[0], "max_ratio": thresholds[1]}
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


@pytest.mark.parametrize(("name", "value"), [("max_ratio", math.nan), ("max_ratio", -0.1), ("max_hamming", -1)])
@pytest.mark.parametrize("size", [32, 16])
def test_threshold_that_no_match_can_pass_is_an_error(name: str, value: float, size: int) -> None:
    descriptors = torch.zeros(4, size, dtype=torch.uint8)
    with pytest.raises(ConfigError, match=f"^{name} is {value}; give a .*number of at least 0$"):
        match_descriptors(descriptors, descriptors, **{name: value})  # type: ignore[arg-type]


def test_ratio_of_infinity_to_equal_descriptors_matches_nothing_in_both_implementations() -> None:
    """The limit is infinity times 0, which no distance is below."""
    a = random_descriptors(4, 0)
    twin = TWINS["v3d_torch.features.matching.match_descriptors"]
    for match in twin if ENABLED else (twin.torch,):
        assert match(a, torch.cat([a, a]), max_ratio=float("inf")).tolist() == 4 * [-1]
