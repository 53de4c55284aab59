"""Clock of live processing, replaceable by a simulated one in tests."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Clock whose time never decreases."""

    def now(self) -> float:
        """Time since an arbitrary start, seconds."""

    def sleep(self, seconds: float) -> None:
        """Wait; return at once if the time is not positive."""


class MonotonicClock:
    """Clock of this computer, `time.monotonic`."""

    def now(self) -> float:
        """Time since an arbitrary start, seconds."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait; return at once if the time is not positive."""
        time.sleep(max(seconds, 0.0))


MONOTONIC_CLOCK = MonotonicClock()
"""Default clock."""
