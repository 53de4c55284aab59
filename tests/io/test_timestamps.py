"""Times as datasets write them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.io.timestamps import parse_timestamp


@pytest.mark.parametrize("written", ["1305031102.175304", "0", "-3.5", "7", "1e3"])
def test_seconds_stay(written: str) -> None:
    assert parse_timestamp(written) == float(written)


@given(nanoseconds=st.integers(10**18, 9 * 10**18))
def test_counts_since_1970_become_seconds(nanoseconds: int) -> None:
    expected = nanoseconds / 1e9
    for written in (f"{nanoseconds}", f"{nanoseconds:.18e}", f"{nanoseconds // 1000}", f"{nanoseconds // 10**6}"):
        assert parse_timestamp(written) == pytest.approx(expected, abs=2e-3, rel=0)
    assert parse_timestamp(f"{nanoseconds}") == pytest.approx(expected, abs=1e-6, rel=0)


@pytest.mark.parametrize("written", ["", "frame1", "1:30", "1,5"])
def test_words_are_refused(written: str) -> None:
    with pytest.raises(ValueError, match="could not convert"):
        parse_timestamp(written)
