"""Paired comparison of configurations: how much larger or smaller the errors of one are, and whether that is chance.

Runs with the same sequence and seed form a pair. Errors of different sequences have different scales, so their ratios
are compared, as differences of logarithms. The interval of a sequence is that of the mean over its seeds. The interval
over all sequences is that of the mean of the sequences: runs of one sequence are no independent evidence for others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from v3d_torch.evaluation.outcome import Outcome, label_sequence
from v3d_torch.evaluation.outcome_groups import OutcomeGroups
from v3d_torch.evaluation.tables import Cell, ErrorTable

CONFIDENCE = 0.95
"""Confidence of the intervals."""

_DIGITS = 3
"""Number of printed decimals of a ratio."""

ALL_SEQUENCES = "all sequences"
"""Name of the row with the mean over the sequences."""


@dataclass(frozen=True)
class Ratio:
    """Ratio of errors with its confidence interval.

    Attributes:
        mean: Geometric mean.
        low: Lower end of the interval; NaN for a single pair.
        high: Upper end of the interval; NaN for a single pair.
    """

    mean: float
    low: float = math.nan
    high: float = math.nan

    @property
    def is_significant(self) -> bool:
        """True if the interval does not contain 1, as printed: smaller differences are those of rounding."""
        return round(self.low, _DIGITS) > 1 or round(self.high, _DIGITS) < 1

    def __str__(self) -> str:
        mean, low, high = (f"{value:.{_DIGITS}f}" for value in (self.mean, self.low, self.high))
        return mean + (f" [{low}-{high}]" if math.isfinite(self.low) else "")


def mean_ratio(ratios: Sequence[float]) -> Ratio:
    """Compute the geometric mean of ratios and the interval of Student's t-distribution of their logarithms.

    Args:
        ratios: Independent ratios, at least one, greater than 0.
    """
    logarithms = np.log(np.asarray(ratios, np.float64))
    mean = float(logarithms.mean())
    if len(ratios) < 2:
        return Ratio(math.exp(mean))
    error = float(logarithms.std(ddof=1)) / math.sqrt(len(ratios))
    reach = error * float(scipy.special.stdtrit(len(ratios) - 1, (1 + CONFIDENCE) / 2))
    return Ratio(math.exp(mean), math.exp(mean - reach), math.exp(mean + reach))


def compare_configurations(outcomes: Sequence[Outcome], key: str, heading: str) -> ErrorTable | None:
    """Compare each configuration with the first one, on each sequence and over all sequences.

    Sequences that are a part of a benchmark's sequence, or another recording, do not count for all sequences.

    Args:
        outcomes: Outcomes of the runs.
        key: Key of the error in ``metrics.json``.
        heading: Name of the error.

    Returns:
        Table of ratios, significant ones marked as best or worse; None if there are too few runs for an interval.
    """
    groups = OutcomeGroups(outcomes)
    reference, others = groups.configs[0] if groups.configs else "", groups.configs[1:]
    rows: dict[str, tuple[Cell, ...]] = {}
    means: Mapping[str, list[float]] = {config: [] for config in others}
    for sequence in groups.sequences:
        difference, cells = groups.find_difference(sequence), []
        for config in others:
            pairs = _paired_ratios(groups.of(sequence, config), groups.of(sequence, reference), key)
            cells.append(_cell(pairs))
            if pairs and difference is None:
                means[config].append(mean_ratio(pairs).mean)
        if any(cell.text != "-" for cell in cells):
            rows[label_sequence(sequence, difference)] = tuple(cells)
    if any(len(each) > 1 for each in means.values()):
        rows[ALL_SEQUENCES] = tuple(_cell(means[config]) for config in others)
    if not any("[" in cell.text for cells in rows.values() for cell in cells):
        return None
    return ErrorTable(f"{heading} relative to {reference}", tuple(others), rows)


def _paired_ratios(runs: Iterable[Outcome], reference_runs: Iterable[Outcome], key: str) -> list[float]:
    """Ratios of the errors of a configuration to those of the reference with the same seed."""
    errors, reference_errors = (_errors_by_seed(each, key) for each in (runs, reference_runs))
    return [value / reference_errors[seed] for seed, value in errors.items() if seed in reference_errors]


def _errors_by_seed(runs: Iterable[Outcome], key: str) -> dict[int, float]:
    return {
        run.seed: value
        for run in runs
        if run.failure is None and (value := run.get_metric(key))  # an error of 0 has no logarithm
    }


def _cell(ratios: Sequence[float]) -> Cell:
    if not ratios:
        return Cell("-", best=False)
    ratio = mean_ratio(ratios)
    return Cell(str(ratio), best=ratio.is_significant and ratio.mean < 1, worse=ratio.is_significant and ratio.mean > 1)
