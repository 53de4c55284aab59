"""Random access to items that can only be read in order."""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterator
from functools import partial

import pytest

from v3d_torch.datasets.cursor import Cursor
from v3d_torch.errors import InputError


def test_cursor_restarts_the_stream_only_to_go_back() -> None:
    start_count = 0

    def start() -> Iterator[str]:
        nonlocal start_count
        start_count += 1
        return iter("abcde")

    cursor = Cursor(start)
    assert [cursor[i] for i in (0, 1, 3, 3, 4)] == list("abdde") and start_count == 1
    assert [cursor[i] for i in (1, 2, 0)] == list("bca") and start_count == 3
    with pytest.raises(IndexError):
        cursor[5]
    assert cursor[2] == "c"


def test_stream_is_opened_again_after_it_raised() -> None:
    errors = [InputError("is damaged")]

    def start() -> Iterator[str]:
        yield "a"
        if errors:
            raise errors.pop()
        yield "b"

    cursor = Cursor(start)
    assert cursor[0] == "a"
    with pytest.raises(InputError, match="is damaged"):
        cursor[1]
    assert cursor[1] == "b"


def test_pickled_cursor_starts_again() -> None:
    cursor = Cursor(partial(iter, "abc"))
    assert cursor[2] == "c"
    copy = pickle.loads(pickle.dumps(cursor))  # noqa: S301
    assert copy[0] == "a" and cursor[2] == "c"


def test_cursor_starts_again_in_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[Iterator[str]] = []

    def start() -> Iterator[str]:
        starts.append(iter("abcde"))
        return starts[-1]

    cursor = Cursor(start)
    assert cursor[1] == "b"
    monkeypatch.setattr(os, "getpid", lambda: -1)  # as in a process that was forked
    assert [cursor[1], cursor[3]] == ["b", "d"] and len(starts) == 2
    assert next(starts[0]) == "c"  # the position of the parent has not changed
