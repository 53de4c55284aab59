"""Parsing of timestamps in the units of all datasets, and association of timestamps."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.io.timestamps import associate, parse_timestamp


@pytest.mark.parametrize("text", ["1305031102.175304", "0", "-3.5", "7", "1e3"])
def test_seconds_are_parsed_unchanged(text: str) -> None:
    assert parse_timestamp(text) == float(text)


@given(nanoseconds=st.integers(10**18, 9 * 10**18))
def test_counts_since_1970_are_converted_to_seconds(nanoseconds: int) -> None:
    expected = nanoseconds / 1e9
    for text in (f"{nanoseconds}", f"{nanoseconds:.18e}", f"{nanoseconds // 1000}", f"{nanoseconds // 10**6}"):
        assert parse_timestamp(text) == pytest.approx(expected, abs=2e-3, rel=0)
    assert parse_timestamp(f"{nanoseconds}") == pytest.approx(expected, abs=1e-6, rel=0)


@pytest.mark.parametrize("text", ["", "frame1", "1:30", "1,5"])
def test_text_that_is_not_a_number_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="could not convert"):
        parse_timestamp(text)


# Binary fractions have exact differences, so that equal differences compare equal.
TICKS = st.lists(st.integers(0, 2000), unique=True, max_size=60).map(
    lambda ticks: [tick / 1024 for tick in sorted(ticks)]
)


@given(first=TICKS, second=TICKS)
def test_association_pairs_nearest_stamps_first(first: list[float], second: list[float]) -> None:
    """Reference: the benchmark's tool, which sorts all differences and uses each stamp once."""
    limit = 20 / 1024
    near = sorted((abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) <= limit)
    expected: dict[int, int] = {}
    for _, i, j in near:
        if i not in expected and j not in expected.values():
            expected[i] = j
    assert associate(first, second, limit) == sorted(expected.items())
