"""What one run of several gave: the figures of its ``metrics.json``, or the sentence that it failed with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """What one run gave.

    Attributes:
        sequence: name.
        config: name of the configuration, such as ``full``.
        seed: of the run.
        metrics: as in its ``metrics.json``; empty where it failed.
        failure: the sentence that it failed with; None where it did not.
    """

    sequence: str
    config: str
    seed: int
    metrics: Mapping[str, Any]
    failure: str | None = None

    def figure(self, place: str) -> float | None:
        """The value at ``place``, such as ``ate.rmse``; None where it was not measured."""
        value: Any = self.metrics
        for key in place.split("."):
            value = (value or {}).get(key)
        return value

    def __str__(self) -> str:
        """One line for whoever waits."""
        ate = self.figure("ate.rmse")
        score = f"ATE {ate:.4f} m" if ate is not None else "no ground truth to score it"
        result = score if self.failure is None else f"failed: {self.failure}"
        return f"{self.sequence}, {self.config}, seed {self.seed}: {result}"


def values_of(outcomes: Iterable[Outcome], place: str) -> list[float]:
    """A figure of some runs, without those in which it was not measured."""
    figures = (outcome.figure(place) for outcome in outcomes)
    return [figure for figure in figures if figure is not None]
