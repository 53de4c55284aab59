"""Time of a call, and of competitors that take turns."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

OURS = "v3d_torch"
"""Name of this package among competitors."""

Competitors = dict[str, Callable[[], Any]]

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


def take_turns(competitors: Competitors, turns: int) -> dict[str, list[float]]:
    """Measure the milliseconds of each competitor in each turn; turns are added until one second has passed."""
    times: dict[str, list[float]] = {name: [] for name in competitors}
    shuffler = np.random.default_rng(0)  # random order, because the competitor after the slowest has a cold cache
    end = time.perf_counter() + 1
    while len(times[OURS]) <= turns or time.perf_counter() < end:
        for name in shuffler.permutation(list(competitors)):
            start = time.perf_counter()
            competitors[name]()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: values[1:] for name, values in times.items()}  # without the first, which warms up
