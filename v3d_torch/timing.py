"""Seconds spent in each stage."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
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
            self.add({stage: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add what another clock measured, by stage."""
        for stage, elapsed in seconds.items():
            self.seconds[stage] += elapsed
            self._lap[stage] += elapsed

    def lap(self) -> dict[str, float]:
        """Seconds by stage since this was last asked: of a frame, when asked after each."""
        lap, self._lap = dict(self._lap), defaultdict(float)
        return lap
