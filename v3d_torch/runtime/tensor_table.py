"""Growable table of tensors: columns of equal length to which rows are appended."""

from __future__ import annotations

import torch
from torch import Tensor

_INITIAL_ROWS = 256


class TensorTable:
    """Tensor columns that grow together; appending costs amortised constant time per row.

    Args:
        columns: Trailing shape and dtype of each column, by name.
    """

    def __init__(self, **columns: tuple[tuple[int, ...], torch.dtype]) -> None:
        self._length = 0
        self._columns = {
            name: torch.zeros(_INITIAL_ROWS, *shape, dtype=dtype) for name, (shape, dtype) in columns.items()
        }

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, name: str) -> Tensor:
        """Return a column as a view: writing to the view changes the table."""
        return self._columns[name][: self._length]

    @property
    def columns(self) -> dict[str, Tensor]:
        """All columns by name, as views."""
        return {name: self[name] for name in self._columns}

    def append(self, **rows: Tensor) -> Tensor:
        """Append rows and return their indices, int64.

        Args:
            rows: Values of every column, by name.

        Raises:
            KeyError: If a column is missing or unknown.
        """
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

    def keep_rows(self, mask: Tensor) -> None:
        """Remove all rows except those in a bool mask; the remaining rows keep their order."""
        rows = torch.nonzero(mask)[:, 0]
        # index_select is faster than indexing here.
        self._columns = {name: column.index_select(0, rows) for name, column in self.columns.items()}
        self._length = len(rows)
