"""Reading of text files, and shortening of texts."""

from __future__ import annotations

from pathlib import Path

import pytest

from v3d_torch.errors import InputError
from v3d_torch.io import text
from v3d_torch.io.text import read_text, shorten


def test_text_of_the_maximum_length_is_read_and_a_longer_one_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text, "_MAX_LENGTH", 10)
    path = tmp_path / "list.txt"
    path.write_text("0123456789")
    assert read_text(path, "a list") == "0123456789"
    path.write_text("0123456789a")
    with pytest.raises(InputError, match=r"list\.txt: is larger than .*; check that it is the right file \(a list\)"):
        read_text(path, "a list")


@pytest.mark.parametrize(
    ("length", "expected"), [(9, "abcdefghi"), (8, "abcd…ghi"), (7, "abc…ghi"), (2, "a…"), (1, "…")]
)
def test_shortened_text_has_the_given_length_and_both_ends(length: int, expected: str) -> None:
    assert shorten("abcdefghi", length) == expected
    assert len(expected) <= length
