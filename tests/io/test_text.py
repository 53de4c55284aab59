"""Texts for messages and tables."""

from __future__ import annotations

import pytest

from v3d_torch.io.text import shorten


@pytest.mark.parametrize(
    ("length", "expected"), [(9, "abcdefghi"), (8, "abcd…ghi"), (7, "abc…ghi"), (2, "a…"), (1, "…")]
)
def test_shortened_text_has_the_given_length_and_both_ends(length: int, expected: str) -> None:
    assert shorten("abcdefghi", length) == expected
    assert len(expected) <= length
