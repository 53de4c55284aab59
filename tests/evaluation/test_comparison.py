"""Paired comparison of configurations: intervals against SciPy, coverage of the truth, pairs that count."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from v3d_torch.evaluation.comparison import ALL_SEQUENCES, compare_configurations, mean_ratio
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.evaluation.tables import format_markdown_table


def run(sequence: str, config: str, seed: int, ate: float | None, difference: str | None = None) -> Outcome:
    if ate is None:
        return Outcome(sequence, config, seed, {}, "it broke")
    return Outcome(sequence, config, seed, {"ate": {"rmse": ate}, "difference": difference})


def test_interval_is_that_of_a_paired_t_test_of_logarithms() -> None:
    ratios = [1.1, 0.9, 1.3, 1.25, 1.05]
    found = mean_ratio(ratios)
    expected = stats.ttest_1samp(np.log(ratios), 0.0)
    interval = expected.confidence_interval(0.95)
    assert (math.log(found.low), math.log(found.high)) == pytest.approx((interval.low, interval.high))
    assert found.mean == pytest.approx(stats.gmean(ratios))
    assert found.is_significant == (expected.pvalue < 0.05)
    assert mean_ratio([0.5]).is_significant is False and str(mean_ratio([0.5])) == "0.500"


def test_difference_that_is_not_printed_is_not_significant() -> None:
    """Runs whose errors differ only by rounding are not marked."""
    ratio = mean_ratio([1 + 1e-9, 1 + 1.1e-9, 1 + 1e-9])
    assert ratio.low > 1 and str(ratio) == "1.000 [1.000-1.000]"
    assert not ratio.is_significant


def test_interval_contains_the_truth_in_19_of_20_cases() -> None:
    generator = np.random.default_rng(0)
    samples = np.exp(generator.normal(math.log(0.8), 0.3, (2000, 4)))
    inside = [ratio.low <= 0.8 <= ratio.high for ratio in map(mean_ratio, samples)]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)


def test_runs_with_the_same_sequence_and_seed_are_compared() -> None:
    outcomes = [
        *(run("a", "full", seed, 0.01 * (1 + seed)) for seed in range(3)),
        *(run("a", "fast", seed, 0.02 * (1 + seed)) for seed in (2, 1)),  # twice as large, whatever the seed
        run("a", "fast", 0, None),
        *(run("b", config, 0, ate) for config, ate in (("full", 1.0), ("fast", 4.0))),
        *(run("c", config, 0, ate, "part: 6 of 8 frames") for config, ate in (("full", 1.0), ("fast", 9.0))),
        run("d", "full", 0, 0.1),
        run("e", "other", 0, 0.1),
    ]
    table = compare_configurations(outcomes, "ate.rmse", "ATE")
    assert table is not None and table.heading == "ATE relative to full" and table.methods == ("fast", "other")
    texts = {name: [cell.text for cell in cells] for name, cells in table.rows.items()}
    assert texts == {
        "a": ["2.000 [2.000-2.000]", "-"],
        "b": ["4.000", "-"],
        "c (part: 6 of 8 frames)": ["9.000", "-"],
        ALL_SEQUENCES: ["2.828 [0.035-231.217]", "-"],
    }
    marks = [(table.rows[name][0].best, table.rows[name][0].worse) for name in ("a", "b", ALL_SEQUENCES)]
    assert marks == [(False, True), (False, False), (False, False)]
    assert format_markdown_table(table)[5:7] == ["| a | **2.000 [2.000-2.000]** | - |", "| b | 4.000 | - |"]


@pytest.mark.parametrize("outcomes", [[], [run("a", "full", 0, 0.1)], [run("a", "x", 0, 0.1), run("a", "y", 1, 0.1)]])
def test_nothing_to_compare_gives_no_table(outcomes: list[Outcome]) -> None:
    assert compare_configurations(outcomes, "ate.rmse", "ATE") is None
