"""Imports without garbage collection, and import path of other processes."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

from v3d_torch.runtime.imports import import_environment, quick_imports


def test_garbage_is_collected_again_afterwards_also_after_an_error() -> None:
    with quick_imports():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ImportError), quick_imports():
        import v3d_torch.nowhere  # noqa: F401
    assert gc.isenabled()


def test_garbage_stays_disabled_if_it_was_disabled() -> None:
    gc.disable()
    try:
        with quick_imports():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_objects_are_frozen_once() -> None:
    with quick_imports():
        pass
    frozen = gc.get_freeze_count()
    kept = [[] for _ in range(1000)]
    with quick_imports():
        pass
    assert gc.get_freeze_count() <= frozen + len(kept) // 2


def test_new_process_imports_from_the_folders_of_this_one_in_the_same_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And not from the current folder."""
    for folder in ("first", "second", "current"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "v3d_lab.py").write_text(f"print({folder!r})")
    monkeypatch.syspath_prepend(tmp_path / "second")
    monkeypatch.syspath_prepend(tmp_path / "first")
    done = subprocess.run(
        [sys.executable, "-c", "import v3d_lab"],
        cwd=tmp_path / "current",
        env=os.environ | import_environment(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "first\n"
