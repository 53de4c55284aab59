"""The queue that holds the newest item only, and the first one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest

from v3d_torch.live.latest_queue import LatestQueue


def test_newer_item_replaces_the_one_that_waits_but_not_the_first() -> None:
    queue = LatestQueue[int]()
    for item in range(1000):
        queue.put(item)
    assert queue.take() == 0
    assert queue.take() == 999
    for item in range(1000, 2000):
        queue.put(item)
    queue.close()
    assert queue.take() == 1999
    assert queue.take() is None


def test_take_waits_for_an_item() -> None:
    queue, begun = LatestQueue[int](), Event()

    def take() -> int | None:
        begun.set()
        return queue.take()

    with ThreadPoolExecutor(1) as executor:
        taken = executor.submit(take)
        begun.wait()
        assert not taken.done()
        queue.put(7)
        assert taken.result(timeout=5) == 7


def test_close_wakes_the_thread_that_waits() -> None:
    queue = LatestQueue[int]()
    with ThreadPoolExecutor(1) as executor:
        taken = executor.submit(queue.take)
        queue.close()
        assert taken.result(timeout=5) is None


def test_error_is_raised_after_the_last_item() -> None:
    queue = LatestQueue[int]()
    queue.put(7)
    queue.close(ValueError("the end"))
    queue.close()  # has no effect
    assert queue.take() == 7
    for _ in range(2):
        with pytest.raises(ValueError, match="the end"):
            queue.take()


def test_closed_queue_ignores_items() -> None:
    queue = LatestQueue[int]()
    queue.close()
    queue.put(7)
    assert queue.take() is None
