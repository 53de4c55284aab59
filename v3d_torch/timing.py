"""Seconds spent in each stage."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class StageClock:
    """Adds up wall time by stage.

    Attributes:
        seconds: stage to total, in the order in which the stages first ran.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._lap: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time the block under ``stage``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[stage] += elapsed
            self._lap[stage] += elapsed

    def lap(self) -> dict[str, float]:
        """Seconds by stage since this was last asked: of a frame, when asked after each."""
        lap, self._lap = dict(self._lap), defaultdict(float)
        return lap
