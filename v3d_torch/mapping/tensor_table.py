"""A growable table of tensors: columns of equal length that rows are appended to."""

from __future__ import annotations

import torch
from torch import Tensor


class TensorTable:
    """Columns of tensors that grow together; appending costs amortised constant time per row.

    Args:
        columns: name to (trailing shape, dtype).
    """

    def __init__(self, **columns: tuple[tuple[int, ...], torch.dtype]) -> None:
        self._length = 0
        self._columns = {name: torch.zeros(256, *shape, dtype=dtype) for name, (shape, dtype) in columns.items()}

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, name: str) -> Tensor:
        """A column as a view: writing to it changes the table."""
        return self._columns[name][: self._length]

    @property
    def columns(self) -> dict[str, Tensor]:
        """All columns by name, as views."""
        return {name: self[name] for name in self._columns}

    def append(self, **rows: Tensor) -> Tensor:
        """Add rows, every column given; returns their indices, int64."""
        if rows.keys() != self._columns.keys():
            raise KeyError(f"rows have {sorted(rows)}, the table has {sorted(self._columns)}")
        count = next(iter(rows.values())).shape[0]
        end = self._length + count
        for name, values in rows.items():
            column = self._columns[name]
            if end > column.shape[0]:
                grown = torch.zeros(max(end, 2 * column.shape[0]), *column.shape[1:], dtype=column.dtype)
                grown[: self._length] = column[: self._length]
                self._columns[name] = column = grown
            column[self._length : end] = values
        indices = torch.arange(self._length, end)
        self._length = end
        return indices

    def keep_rows(self, rows: Tensor) -> None:
        """Drop all rows but those where ``rows``, bool, is true; the others move up, and keep their order."""
        self._columns = {name: column[rows] for name, column in self.columns.items()}
        self._length = int(rows.sum())


def unique_ids(numbers: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """What `torch.unique` tells of whole numbers from 0 to below ``count``, without sorting them.

    Args:
        numbers: int64, shape :math:`(N,)`.
        count: beyond the greatest that there may be.

    Returns:
        The different ones, ascending, int64, shape :math:`(D,)`, and where each number is among them, :math:`(N,)`.
    """
    there = torch.zeros(count, dtype=torch.bool).index_fill_(0, numbers, True)
    return torch.nonzero(there)[:, 0], (there.cumsum(0) - 1).index_select(0, numbers)
