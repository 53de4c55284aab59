"""Cells and rows of the tables that set several runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median


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


def row(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
