"""Random access to items that can only be read in order."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from v3d_torch.datasets.stored import Cursor


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
