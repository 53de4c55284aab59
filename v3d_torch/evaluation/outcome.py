"""Outcome of one run of a batch: the metrics of its ``metrics.json``, or an error message."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from v3d_torch.io.text import printable


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

    @property
    def run(self) -> str:
        """Sequence, configuration and seed, which name the run in texts."""
        return f"{self.sequence}, {self.config}, seed {self.seed}"

    @property
    def warnings(self) -> list[str]:
        """Contradictions between images and camera, notes on the source, and map files that were not written.

        They are one sentence each. A failed run has none.
        """
        return list(self.metrics.get("warnings", ()))

    @property
    def notes(self) -> list[str]:
        """Sentences on the scores, such as on an alignment by orientations or on missing scores."""
        return list(self.metrics.get("notes", ()))

    @property
    def diagnosis(self) -> str | None:
        """Cause of incomplete results, such as a camera that was not found in any frame; None if there is none."""
        diagnosis: str | None = self.metrics.get("diagnosis")
        return diagnosis

    @property
    def difference(self) -> str | None:
        """Description of the difference to the sequence of the benchmark with this name; None if there is none."""
        difference: str | None = self.metrics.get("difference")
        return difference

    def get_metric(self, key: str) -> float | None:
        """Return a metric by its dotted key, such as ``ate.rmse``; None if it was not measured."""
        value: Any = self.metrics
        for name in key.split("."):
            value = (value or {}).get(name)
        return value

    def __str__(self) -> str:
        ate = self.get_metric("ate.rmse")
        cause = self.diagnosis or "; ".join(self.notes) or "no ground truth, not scored"
        score = f"ATE {ate:.4f} m" if ate is not None else cause
        if self.difference is not None:
            score += f" ({self.difference})"
        if skipped := self.get_metric("skipped"):
            score += f", {skipped:.0f} broken frame{'s' if skipped > 1 else ''} skipped"
        result = score if self.failure is None else f"failed: {self.failure}"
        return f"{self.run}: {result}"


def label_sequence(sequence: str, difference: str | None) -> str:
    """Return the name of a sequence in tables, followed by its difference to the sequence of the benchmark, if any."""
    return printable(sequence if difference is None else f"{sequence} ({difference})")


def collect_metric(outcomes: Iterable[Outcome], key: str) -> list[float]:
    """Collect a metric of several runs, without the runs in which it was not measured."""
    values = (outcome.get_metric(key) for outcome in outcomes)
    return [value for value in values if value is not None]
