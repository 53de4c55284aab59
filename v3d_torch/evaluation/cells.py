"""Cells and rows of the tables that set several runs side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import NamedTuple


class Cell(NamedTuple):
    """What a cell says, and whether it is the best of those that it is compared with."""

    text: str
    best: bool


def spread(values: Sequence[float], form: str) -> str:
    """Median and range of some values, which is left out when there is none to see.

    Args:
        values: of the runs, in any order; none makes a dash.
        form: how each is written, a format such as ``.4f``.
    """
    if not values:
        return "-"
    middle, low, high = (format(value, form) for value in (median(values), min(values), max(values)))
    return middle if low == high else f"{middle} [{low}-{high}]"


def shown_lowest(values: Iterable[float], form: str) -> str:
    """The lowest of some values as it is written; what is not shown is no difference, several may be the best."""
    return format(min(values), form)


def row(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
