"""Queue between two threads that contains only the newest item."""

from __future__ import annotations

from threading import Condition
from typing import Generic, TypeVar

_T = TypeVar("_T")


class LatestQueue(Generic[_T]):
    """Queue of length one: a new item replaces an item that was not taken yet.

    One thread puts items and closes the queue, another thread takes them. At most one item waits.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._item: _T | None = None
        self._is_closed = False
        self._error: BaseException | None = None

    def put(self, item: _T) -> None:
        """Put an item, and discard an item that waits. A closed queue ignores the item."""
        with self._changed:
            if not self._is_closed:
                self._item = item
                self._changed.notify()

    def take(self) -> _T | None:
        """Wait for an item and remove it.

        Returns:
            The newest item; None if the queue is closed and empty.

        Raises:
            BaseException: The error with which the queue was closed, after its last item was taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._is_closed)
            item, self._item = self._item, None
        if item is None and self._error is not None:
            raise self._error
        return item

    def close(self, error: BaseException | None = None) -> None:
        """Accept no more items. Only the first call has an effect.

        Args:
            error: Error that `take` raises after the last item; None if `take` returns None.
        """
        with self._changed:
            if not self._is_closed:
                self._is_closed, self._error = True, error
                self._changed.notify()
