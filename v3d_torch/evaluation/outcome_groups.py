"""Outcomes of many runs, grouped once, so that tables of them take a time in proportion to their number."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from v3d_torch.evaluation.outcome import Outcome


class OutcomeGroups:
    """Outcomes by sequence and configuration.

    Args:
        outcomes: Outcomes in any order.

    Attributes:
        sequences: Names of the sequences, in the order of their first outcome.
        configs: Names of the configurations, in the order of their first outcome.
    """

    def __init__(self, outcomes: Iterable[Outcome]) -> None:
        self._groups: dict[tuple[str, str], list[Outcome]] = {}
        self._differences: dict[str, str] = {}
        for outcome in outcomes:
            self._groups.setdefault((outcome.sequence, outcome.config), []).append(outcome)
            if outcome.difference is not None:
                self._differences.setdefault(outcome.sequence, outcome.difference)
        self.sequences = list(dict.fromkeys(sequence for sequence, _ in self._groups))
        self.configs = list(dict.fromkeys(config for _, config in self._groups))

    def of(self, sequence: str, config: str) -> Sequence[Outcome]:
        """Outcomes of a configuration on a sequence, one per seed; empty if it was not run."""
        return self._groups.get((sequence, config), ())

    def of_sequence(self, sequence: str) -> list[Outcome]:
        """Outcomes of all configurations on a sequence, ordered by configuration."""
        return [outcome for config in self.configs for outcome in self.of(sequence, config)]

    def find_difference(self, sequence: str) -> str | None:
        """Return the difference of a sequence to that of the benchmark with its name; None if no run recorded one."""
        return self._differences.get(sequence)
