"""Time spent in each stage."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any


class StageTimer:
    """Sums the wall time of each stage.

    Attributes:
        seconds: Total time by stage, seconds, in the order in which the stages first ran.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._lap: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Measure the time of a ``with`` block."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add({stage: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add times that another timer measured, by stage."""
        for stage, elapsed in seconds.items():
            for total in (self.seconds, self._lap):
                total[stage] = total.get(stage, 0.0) + elapsed

    def lap(self) -> dict[str, float]:
        """Return the time of each stage since the last call, and start a new lap."""
        lap, self._lap = self._lap, {}
        return lap

    def state_dict(self) -> dict[str, Any]:
        """Return the times measured so far."""
        return {"seconds": self.seconds, "lap": self._lap}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the times of `state_dict`."""
        self.seconds, self._lap = dict(state["seconds"]), dict(state["lap"])
