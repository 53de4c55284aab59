"""Seconds spent in each stage."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class StageTimer:
    """Adds up wall time by stage.

    Attributes:
        seconds: stage to total, in the order in which the stages first ran.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._lap: dict[str, float] = {}

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
            for total in (self.seconds, self._lap):
                total[stage] = total.get(stage, 0.0) + elapsed

    def lap(self) -> dict[str, float]:
        """Seconds by stage since this was last asked: of a frame, when asked after each."""
        lap, self._lap = self._lap, {}
        return lap
