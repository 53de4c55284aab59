"""Time spent in each stage."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple


class StageTime(NamedTuple):
    """Time spent in a stage.

    Attributes:
        wall: Wall time, seconds.
        cpu: Processor time of the thread that ran the stage, seconds.
    """

    wall: float = 0.0
    cpu: float = 0.0


class StageTimer:
    """Sums the time of each stage.

    Attributes:
        times: Total time by stage, in the order in which the stages first ran.
    """

    def __init__(self) -> None:
        self.times: dict[str, StageTime] = {}
        self._lap: dict[str, StageTime] = {}

    @property
    def seconds(self) -> dict[str, float]:
        """Total wall time by stage, seconds."""
        return {stage: spent.wall for stage, spent in self.times.items()}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Measure the time of a ``with`` block."""
        wall, cpu = time.perf_counter(), time.thread_time()
        try:
            yield
        finally:
            self.add({stage: StageTime(time.perf_counter() - wall, time.thread_time() - cpu)})

    def add(self, times: Mapping[str, StageTime]) -> None:
        """Add times that another timer measured, by stage."""
        for stage, elapsed in times.items():
            for total in (self.times, self._lap):
                wall, cpu = total.get(stage, StageTime())
                total[stage] = StageTime(wall + elapsed.wall, cpu + elapsed.cpu)

    @property
    def lap_times(self) -> Mapping[str, StageTime]:
        """Time of each stage since the last call of `lap`."""
        return self._lap

    def lap(self) -> dict[str, StageTime]:
        """Return the time of each stage since the last call, and start a new lap."""
        lap, self._lap = self._lap, {}
        return lap

    def state_dict(self) -> dict[str, Any]:
        """Return the times measured so far."""
        return {"times": self.times, "lap": self._lap}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the times of `state_dict`."""
        self.times, self._lap = dict(state["times"]), dict(state["lap"])
