"""Imports without garbage collection."""

from __future__ import annotations

import gc

import pytest

from v3d_torch.runtime.imports import quick_imports


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
