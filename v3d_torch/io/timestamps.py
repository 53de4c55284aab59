"""Timestamps: parsing, and association of two clocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def associate(first: Sequence[float], second: Sequence[float], max_difference: float) -> list[tuple[int, int]]:
    """Pair two sorted lists of stamps one to one, the nearest first, as the TUM benchmark's ``associate.py`` does.

    Args:
        first: seconds, increasing.
        second: seconds, increasing.
        max_difference: farther stamps are no pair, seconds.

    Returns:
        (index in ``first``, index in ``second``), in order of the former.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    start = np.searchsorted(b, a - max_difference, side="left")
    count = np.searchsorted(b, a + max_difference, side="right") - start
    i = np.repeat(np.arange(len(a)), count)
    j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)
    nearest_first = np.lexsort((j, i, np.abs(a[i] - b[j])))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for here, there in zip(i[nearest_first].tolist(), j[nearest_first].tolist(), strict=True):
        if here not in partner and there not in taken:
            partner[here] = there
            taken.add(there)
    return sorted(partner.items())


_CLOCKS = ((1e18, 1e9), (1e15, 1e6), (1e12, 1e3))
"""Counts since 1970 from here on are nanoseconds, microseconds, milliseconds; and their units a second. As seconds they
would lie thirty thousand years ahead."""


def parse_timestamp(written: str) -> float:
    """A stamp in seconds, from seconds of any origin, or from milli-, micro- or nanoseconds since 1970.

    Raises:
        ValueError: what is written is no number.
    """
    value = float(written)
    return next((value / units for least, units in _CLOCKS if value >= least), value)
