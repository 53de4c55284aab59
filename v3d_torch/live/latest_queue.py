"""Queue between two threads that contains only the newest item, and the first one until it is taken."""

from __future__ import annotations

from threading import Condition
from typing import Generic, TypeVar

_T = TypeVar("_T")

_INTERRUPTIBLE_WAIT = 0.2
"""Longest time of one wait, seconds: on Windows, Ctrl-C does not interrupt a wait without an end."""


class LatestQueue(Generic[_T]):
    """Queue in which a new item replaces an item that was not taken yet, except the first item of all.

    One thread puts items and closes the queue, another thread takes them. At most one item waits, or two until the
    first is taken. The first frame of a camera must not be dropped: it can be the only one with a measured gravity.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._items: list[_T] = []
        self._is_first_waiting = True
        self._is_closed = False
        self._error: BaseException | None = None

    def put(self, item: _T) -> None:
        """Put an item, and discard an item that waits, unless it is the first. A closed queue ignores the item."""
        with self._changed:
            if not self._is_closed:
                first = self._items[:1] if self._is_first_waiting else []
                self._items = [*first, item]
                self._changed.notify()

    def take(self) -> _T | None:
        """Wait for an item and remove it.

        Returns:
            The first item of all, then the newest item; None if the queue is closed and empty.

        Raises:
            BaseException: The error with which the queue was closed, after its last item was taken.
        """
        with self._changed:
            while not self._changed.wait_for(lambda: self._items or self._is_closed, timeout=_INTERRUPTIBLE_WAIT):
                pass
            if self._items:
                self._is_first_waiting = False
                return self._items.pop(0)
        if self._error is not None:
            raise self._error
        return None

    def close(self, error: BaseException | None = None) -> None:
        """Accept no more items. Only the first call has an effect.

        Args:
            error: Error that `take` raises after the last item; None if `take` returns None.
        """
        with self._changed:
            if not self._is_closed:
                self._is_closed, self._error = True, error
                self._changed.notify()
