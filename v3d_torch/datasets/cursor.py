"""Random access to a stream that can only be read forward."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Cursor(Generic[_T]):
    """Random access to the items of a stream that can only be read forward.

    Reading forward continues the stream; reading backward restarts it, and so do reading after an error, and another
    process, to which a cursor was copied or pickled.

    Args:
        start: Function that returns an iterator over all items.
    """

    def __init__(self, start: Callable[[], Iterator[_T]]) -> None:
        self._start = start
        self._process = os.getpid()
        self._items: Iterator[_T] = iter(())
        self._index: int | None = None
        self._item: _T | None = None

    def __getitem__(self, index: int) -> _T:
        """Return item ``index``, counted from 0.

        Raises:
            IndexError: If the stream has no such item.
        """
        if self._process != os.getpid():
            # A process that was forked shares the position in open files with its parent. The files are not closed,
            # because a decoder would wait for its threads, which are not in this process.
            self._of_parent = self._items
            self._process, self._index, self._item = os.getpid(), None, None
        if self._item is not None and index == self._index:
            return self._item
        if self._index is None or index < self._index:
            self._items, self._index = self._start(), -1
        following = islice(self._items, index - self._index - 1, None)
        self._index = self._item = None  # a stream that raises or ends cannot be continued
        if (item := next(following, None)) is None:
            raise IndexError(index)
        self._index, self._item = index, item
        return item

    def __reduce__(self) -> tuple[type[Cursor[_T]], tuple[Callable[[], Iterator[_T]]]]:
        """Pickle the start of the stream alone."""
        return Cursor, (self._start,)
