"""Time of a call, and of implementations that take turns."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

OURS = "v3d_torch"
"""Name of this package among implementations."""

Implementations = dict[str, Callable[[], Any]]

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


_MIN_TURN = 0.02
"""Minimum time of a turn, seconds. Shorter calls are repeated, because the first call after another implementation has
a cold cache, whose cost depends on that implementation."""


def take_turns(implementations: Implementations, turns: int) -> dict[str, list[float]]:
    """Measure the milliseconds of a call of each implementation in each turn, the mean over the calls of the turn.

    Turns are added until one second has passed.
    """
    times: dict[str, list[float]] = {name: [] for name in implementations}
    shuffler = np.random.default_rng(0)  # random order, because the implementation after the slowest has a cold cache
    end = time.perf_counter() + 1
    while len(times[OURS]) <= turns or time.perf_counter() < end:
        for name in shuffler.permutation(list(implementations)):
            start, calls, elapsed = time.perf_counter(), 0, 0.0
            while elapsed < _MIN_TURN:
                implementations[name]()
                calls, elapsed = calls + 1, time.perf_counter() - start
            times[name].append(1e3 * elapsed / calls)
    return {name: values[1:] for name, values in times.items()}  # without the first, which warms up
