"""Times as they are written in lists, trajectories and names of files, to seconds."""

from __future__ import annotations

_CLOCKS = ((1e18, 1e9), (1e15, 1e6), (1e12, 1e3))
"""Counts since 1970 from here on are nanoseconds, microseconds, milliseconds; and their units a second. As seconds they
would lie thirty thousand years ahead."""


def seconds(written: str) -> float:
    """A stamp in seconds, from seconds of any origin, or from milli-, micro- or nanoseconds since 1970.

    Raises:
        ValueError: what is written is no number.
    """
    value = float(written)
    return next((value / units for least, units in _CLOCKS if value >= least), value)
