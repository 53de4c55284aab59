"""Outcome of one run of a batch: the metrics of its ``metrics.json``, or an error message."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run.

    Attributes:
        sequence: Name of the sequence.
        config: Name of the configuration, such as ``full``.
        seed: Random seed of the run.
        metrics: Content of the run's ``metrics.json``; empty if the run failed.
        failure: Error message; None if the run succeeded.
    """

    sequence: str
    config: str
    seed: int
    metrics: Mapping[str, Any]
    failure: str | None = None

    def get_metric(self, key: str) -> float | None:
        """Return a metric by its dotted key, such as ``ate.rmse``; None if it was not measured."""
        value: Any = self.metrics
        for name in key.split("."):
            value = (value or {}).get(name)
        return value

    def __str__(self) -> str:
        ate = self.get_metric("ate.rmse")
        score = f"ATE {ate:.4f} m" if ate is not None else "no ground truth, not scored"
        if skipped := self.get_metric("skipped"):
            score += f", {skipped:.0f} broken frame{'s' if skipped > 1 else ''} passed over"
        result = score if self.failure is None else f"failed: {self.failure}"
        return f"{self.sequence}, {self.config}, seed {self.seed}: {result}"


def collect_metric(outcomes: Iterable[Outcome], key: str) -> list[float]:
    """Collect a metric of several runs, without the runs in which it was not measured."""
    values = (outcome.get_metric(key) for outcome in outcomes)
    return [value for value in values if value is not None]
