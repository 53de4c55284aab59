"""Tables of the ablation study."""

from __future__ import annotations

import csv
import os
from typing import Any

import pytest

from v3d_torch.evaluation.ablation import (
    COLUMNS,
    conclusion,
    format_csv,
    format_markdown,
    make_overview_table,
    make_screen_table,
)
from v3d_torch.evaluation.outcome import Outcome


def outcomes(ates: dict[str, list[float | None]], sequence: str = "s") -> list[Outcome]:
    """Outcomes with given errors; None stands for a failed run."""
    return [
        Outcome(sequence, variant, seed, {}, "a | broke [x]")
        if ate is None
        else Outcome(sequence, variant, seed, {"ate": {"rmse": ate, "std": ate / 2}, "rpe": None, "masks": None})
        for variant, values in ates.items()
        for seed, ate in enumerate(values)
    ]


def test_table_shows_median_range_and_best() -> None:
    document = format_markdown(
        outcomes({"baseline": [0.5, 0.3, 0.4], "full": [0.1, 0.1, 0.1], "paper": [None, 0.2, 0.9]})
    )
    lines = [line for line in document.splitlines() if line.startswith("|")]
    assert lines[0] == "| variant | ATE, m | SD, m | failed |"  # metrics that no run has are omitted
    assert lines[2] == "| baseline | 0.4000 [0.3000-0.5000] | 0.2000 [0.1500-0.2500] | 0 |"
    assert lines[3] == "| full | **0.1000** | **0.0500** | 0 |"
    assert lines[4] == "| paper | 0.5500 [0.2000-0.9000] | 0.2750 [0.1000-0.4500] | 1 |"
    assert "- s, paper, seed 0: failed: a | broke [x]" in document
    same = format_markdown(outcomes({"baseline": [0.10004], "full": [0.1], "paper": [0.1001]}))
    assert same.count("**0.1000**") == 2  # equal as shown


def test_variant_whose_runs_all_failed_has_a_dash() -> None:
    document = format_markdown(outcomes({"baseline": [None, None], "full": [0.1, 0.2]}))
    assert "| baseline | - | - | 2 |" in document
    assert "| variant | failed |\n| --- | ---: |\n| full | 2 |" in format_markdown(outcomes({"full": [None, None]}))


def test_part_of_a_sequence_is_marked() -> None:
    runs = outcomes({"baseline": [0.5], "full": [0.1]})
    part = "part: 60 of 827 frames"
    marked = [Outcome(run.sequence, run.config, run.seed, {**run.metrics, "difference": part}) for run in runs]
    assert f"## s ({part})" in format_markdown(marked)
    assert str(make_screen_table(marked).title) == f"Ablation on s ({part})"
    assert {row["difference"] for row in csv.DictReader(format_csv(marked).splitlines())} == {part}
    overview = make_overview_table(marked)
    assert overview is not None and f"s ({part})" in overview.rows


def test_mask_metrics_have_no_best() -> None:
    def masks(variant: str, fraction: float) -> Outcome:
        scores = {"moving_masked": fraction, "static_masked": fraction / 10, "id_switches_per_60_frames": fraction}
        return Outcome("s", variant, 0, {"ate": None, "rpe": None, "masks": scores})

    document = format_markdown([masks("baseline", 0.0), masks("full", 0.97)])
    assert "| full | 97.0% | 9.7% | 0.97 |" in document and "**" not in document
    assert "no ground truth" in str(masks("full", 0.5))


@pytest.mark.parametrize(
    ("ates", "says"),
    [
        ({"full": [0.1, 0.2, 0.3], "paper": [0.25, 0.3, 0.35]}, "No variant is better"),
        ({"full": [0.1, 0.25, 0.3], "paper": [0.05, 0.1, 0.2]}, "within noise of paper"),
        ({"full": [0.21, 0.25, 0.3], "paper": [0.05, 0.1, 0.2]}, "worse than paper: their ranges"),
        ({"full": [0.21], "paper": [0.2]}, "worse than paper; with one seed, the difference may be noise"),
        ({"paper": [0.01], "full": [0.01004]}, "No variant is better"),  # they differ by less than the table shows
        ({"baseline": [0.1], "paper": [0.2]}, ""),
        ({"full": [None], "paper": [0.2]}, ""),
        ({"full": [0.1], "paper": [None]}, ""),
    ],
)
def test_conclusion_compares_full_with_the_best_variant(ates: dict[str, list[float | None]], says: str) -> None:
    text = conclusion(outcomes(ates))
    assert says in text and bool(says) == bool(text)


def test_each_sequence_has_its_own_table() -> None:
    both = [*outcomes({"full": [0.1]}, "fr3/w/xyz"), *outcomes({"full": [0.3]}, "demo [x]")]
    document = format_markdown(both)
    assert document.index("## fr3/w/xyz") < document.index("0.1000") < document.index("## demo [x]")
    assert "0.1000" not in document[document.index("## demo [x]") :]
    rows = list(csv.DictReader(format_csv(both).splitlines()))
    assert [row["sequence"] for row in rows] == ["fr3/w/xyz", "demo [x]"]
    assert set(COLUMNS) < rows[0].keys()


def test_brackets_in_names_are_not_markup() -> None:
    from rich.console import Console

    console = Console(width=100, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    console.print(make_screen_table(outcomes({"full": [0.1, 0.3], "paper": [0.5, None]}, "demo [red]")))
    text = console.export_text()
    assert "Ablation on demo [red]" in text and "[0.1000-0.3000]" in text


def errors(ate: float) -> dict[str, Any]:
    return {"ate": {"rmse": ate}, "rpe": {"trans": {"rmse": ate / 2}, "rot": {"rmse": 10 * ate}}}


def test_overview_without_runs_is_none_and_variant_without_full_has_no_ratio() -> None:
    assert make_overview_table([]) is None
    runs = [Outcome("fr3/w/xyz", "no_voting", 0, errors(0.04)), Outcome("fr3/s/xyz", "full", 0, errors(0.02))]
    table = make_overview_table(runs)
    assert table is not None
    assert [cell.text for cell in table.rows["ratio to full"]] == ["-", "1.00"]


def test_ratio_to_full_is_geometric_mean_over_sequences() -> None:
    runs = [
        Outcome(sequence, config, 0, errors(ate))
        for sequence, full, times in (("fr3/w/xyz", 0.01, 8.0), ("fr3/s/xyz", 0.3, 2.0))
        for config, ate in (("no_voting", times * full), ("full", full))
    ]
    table = make_overview_table(runs)
    assert table is not None
    assert [cell.text for cell in table.rows["ratio to full"]] == ["4.00", "1.00"]
