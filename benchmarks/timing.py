"""Time of a call."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def timed(call: Callable[[], Result], clock: Callable[[], float] = time.perf_counter) -> tuple[float, Result]:
    """Return the time of a call, seconds, and its result.

    Args:
        call: Function to call.
        clock: Clock to read: wall time by default, `time.process_time` for CPU time.
    """
    start = clock()
    result = call()
    return clock() - start, result
