"""Timestamps: parsing, and association of two lists."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v3d_torch.io.numbers import parse_number

MIN_NANOSECONDS = 1e18
"""Smallest number that is taken for nanoseconds since 1970."""

_UNITS_SINCE_1970 = ((MIN_NANOSECONDS, 1e9), (1e15, 1e6), (1e12, 1e3))
"""Smallest value of nanosecond, microsecond and millisecond counts since 1970, and their units per second.

As seconds since 1970, all these values are more than thirty thousand years ahead.
"""


def parse_timestamp(text: str) -> float:
    """Parse a timestamp.

    Args:
        text: Seconds since any origin, or milliseconds, microseconds or nanoseconds since 1970.

    Returns:
        Timestamp, seconds.

    Raises:
        ValueError: If the text is not a number.
    """
    value = parse_number(text)
    return next((value / units for min_value, units in _UNITS_SINCE_1970 if value >= min_value), value)


def round_timestamp(stamp: float) -> float:
    """Round a timestamp as trajectory files do, to microseconds: poses of equal rounded times would be one pose."""
    return round(stamp, 6)


def format_timestamp(stamp: float) -> str:
    """Return a timestamp with six decimals, as in trajectory files and in the names of image files."""
    return f"{stamp:.6f}"


def associate(first: Sequence[float], second: Sequence[float], max_difference: float) -> list[tuple[int, int]]:
    """Pair two lists of timestamps one to one, nearest pairs first, as the TUM benchmark's ``associate.py`` does.

    Args:
        first: Timestamps, seconds, increasing.
        second: Timestamps, seconds, increasing.
        max_difference: Largest difference of a pair, seconds.

    Returns:
        Pairs (index in ``first``, index in ``second``), sorted by the first index.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    start = np.searchsorted(b, a - max_difference, side="left")
    count = np.searchsorted(b, a + max_difference, side="right") - start
    # All candidate pairs (i, j): each i with count[i] consecutive j from start[i] on.
    i = np.repeat(np.arange(len(a)), count)
    j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)
    nearest_first = np.lexsort((j, i, np.abs(a[i] - b[j])))
    second_of: dict[int, int] = {}
    used_second: set[int] = set()
    for index_first, index_second in zip(i[nearest_first].tolist(), j[nearest_first].tolist(), strict=True):
        if index_first not in second_of and index_second not in used_second:
            second_of[index_first] = index_second
            used_second.add(index_second)
    return sorted(second_of.items())
