"""Waiting for a condition with a limit, so that a broken product fails the test and does not hang it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

INTERVAL = 0.002
"""Time between two checks of a condition, seconds."""


def wait_until(condition: Callable[[], bool], timeout: float, what: str) -> None:
    """Wait until a condition holds.

    Args:
        condition: Function that checks the condition.
        timeout: Time after which the condition counts as missed, seconds.
        what: Condition in words, for the message.

    Raises:
        AssertionError: If the condition does not hold in time.
    """
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {timeout:g} s: {what}")
        time.sleep(INTERVAL)


def steps_until(condition: Callable[[], bool], limit: int, what: str) -> Iterator[int]:
    """Yield 0, 1, 2 ... until a condition holds; the caller does one step for each number.

    Args:
        condition: Function that checks the condition before each step.
        limit: Number of steps after which the condition counts as missed.
        what: Condition in words, for the message.

    Raises:
        AssertionError: If the condition does not hold after the last step.
    """
    for number in range(limit):
        if condition():
            return
        yield number
    if not condition():
        raise AssertionError(f"not after {limit} steps: {what}")
