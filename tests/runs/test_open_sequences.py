"""Sequences opened for a command."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.corpus.base import write_base
from rich.console import Console

from v3d_torch.errors import InputError
from v3d_torch.runs.open_sequences import open_sequences


def test_damaged_ground_truth_is_rejected(tmp_path: Path) -> None:
    write_base(tmp_path / "seq")
    assert list(open_sequences([str(tmp_path / "seq")], None, Console())) == ["seq"]
    (tmp_path / "seq" / "groundtruth.txt").write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"groundtruth\.txt: line 1 is '1 2 3'"):
        open_sequences([str(tmp_path / "seq")], None, Console())
