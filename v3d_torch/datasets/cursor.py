"""Random access to what can only be read in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Cursor(Generic[_T]):
    """Items of a stream by their number; going on is cheap, going back starts again at the first.

    Args:
        start: gives the items from the first.
    """

    def __init__(self, start: Callable[[], Iterator[_T]]) -> None:
        self._start = start
        self._items: Iterator[_T] = iter(())
        self._here: int | None = None
        self._item: _T | None = None

    def __getitem__(self, index: int) -> _T:
        """Item ``index``, from 0; raises IndexError behind the last."""
        if self._item is not None and index == self._here:
            return self._item
        if self._here is None or index < self._here:
            self._items, self._here = self._start(), -1
        self._item = next(islice(self._items, index - self._here - 1, None), None)
        self._here = index
        if self._item is None:
            self._here = None
            raise IndexError(index)
        return self._item
