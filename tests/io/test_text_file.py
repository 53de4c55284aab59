"""Reading of text files."""

from __future__ import annotations

from pathlib import Path

import pytest

from v3d_torch.errors import InputError
from v3d_torch.io import text_file
from v3d_torch.io.text_file import read_text


def test_text_of_the_maximum_length_is_read_and_a_longer_one_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text_file, "_MAX_LENGTH", 10)
    path = tmp_path / "list.txt"
    path.write_text("0123456789")
    assert read_text(path, "a list") == "0123456789"
    path.write_text("0123456789a")
    with pytest.raises(InputError, match=r"list\.txt: is larger than .*; check that it is the right file \(a list\)"):
        read_text(path, "a list")
