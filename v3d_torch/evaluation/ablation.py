"""Ablation study (paper, Sec. IV-D): its variants, and tables of their results."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from io import StringIO
from statistics import geometric_mean, median
from typing import NamedTuple

from rich.table import Table

from v3d_torch.config.loading import FULL
from v3d_torch.evaluation import tables
from v3d_torch.evaluation.outcome import Outcome, collect_metric, label_sequence
from v3d_torch.evaluation.outcome_groups import OutcomeGroups
from v3d_torch.evaluation.paper_tables import HEADINGS
from v3d_torch.evaluation.summary import make_error_tables
from v3d_torch.evaluation.tables import Cell, ErrorTable, format_markdown_table, format_median_and_range

VARIANTS = (
    "baseline",
    "no_voting",
    "no_free_space",
    "no_chamfer",
    "no_prediction",
    "no_appearance",
    "no_unlabelled",
    "not_upright",
    "global_shutter",
    "paper",
    FULL,
)
"""Names of the compared configurations (`v3d_torch.config.loading.CONFIGS`), the full system last."""

LEGEND = (
    "Median and [range] over the seeds. ATE and RPE (over 1 s): RMSE; SD: standard deviation of the ATE. Moving out,"
    " static out: percentage of the truly moving and truly static pixels with depth that tracking left out; id"
    " switches: per 60 frames in which a person is in view; found: percentage of these frames in which an object covers"
    " the person."
)
"""Explanation of the columns."""

PAPER_RESULTS = (
    "The paper (Sec. IV-D) has no table of its ablation, but compares ATEs: without voting, 8 % lower than the baseline"
    " and four times that of the full system; without the intra-object stage (Chamfer distance), 6 % higher than that"
    " of the full system."
)
"""Results of the paper's ablation study."""

PAPER_RATIOS: Mapping[str, float] = {"baseline": 4 / 0.92, "no_voting": 4.0, "no_chamfer": 1.06, FULL: 1.0}
"""ATE of a variant divided by the full system's ATE, from `PAPER_RESULTS`."""

RATIO_LEGEND = (
    "Ratio to full: ATE divided by the full system's ATE, geometric mean over the sequences on which both were run;"
    " (paper): according to the paper's text."
)
"""Explanation of the last rows of `make_overview_table`."""

_RATIO_ROW = "ratio to full"


class Column(NamedTuple):
    """Column of the tables.

    Attributes:
        heading: Heading, with the unit.
        form: Format of a value, such as ``.4f``.
        is_error: True if the lowest value is the best. False if no value is marked as the best.
    """

    heading: str
    form: str
    is_error: bool


COLUMNS: Mapping[str, Column] = {
    "ate.rmse": Column("ATE, m", ".4f", True),
    "ate.std": Column("SD, m", ".4f", True),
    "rpe.trans.rmse": Column("RPE, m/s", ".4f", True),
    "rpe.rot.rmse": Column("RPE, deg/s", ".3f", True),
    # The mask metrics are a trade-off: masking everything, or nothing, makes one of them perfect.
    "masks.moving_masked": Column("moving out", ".1%", False),
    "masks.static_masked": Column("static out", ".1%", False),
    "masks.id_switches_per_60_frames": Column("id switches", ".2f", False),
    "masks.people_found": Column("found", ".0%", False),
}
"""Columns of the tables by their key in ``metrics.json``."""


def make_screen_table(outcomes: Sequence[Outcome]) -> Table:
    """Return the results on one sequence for the screen, one row per variant, the best of each error in green."""
    table = _make_table(outcomes)
    shown = replace(table, heading=f"Ablation on {table.heading}")
    return tables.make_screen_table(shown, "variant", conclusion(outcomes))


def format_markdown(outcomes: Sequence[Outcome], note: str = "") -> str:
    """Return a Markdown document with one table per sequence, the best of each error in bold, and the failed runs.

    Args:
        outcomes: Outcomes of the runs.
        note: Remark on how the runs were made.
    """
    lines = ["# Ablation", LEGEND, "", PAPER_RESULTS, "", *([note] if note else [])]
    groups = OutcomeGroups(outcomes)
    for runs in map(groups.of_sequence, groups.sequences):
        seeds = f"Seeds: {len({run.seed for run in runs})}. {conclusion(runs)}"
        lines += format_markdown_table(_make_table(runs), "variant", seeds)
        lines += ["", *(f"- {run}" for run in runs if run.failure is not None)]
    return "\n".join(lines) + "\n"


def make_overview_table(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> ErrorTable | None:
    """Return the ATE of all variants on all sequences, and its ratio to the full system's ATE.

    Args:
        outcomes: Outcomes of the runs.
        absent: Sequences of the paper that are not available; they have a row without values.

    Returns:
        Table with one column per variant. The last two rows are the geometric mean of the ratio, over the sequences on
        which both were run, and the ratio according to the paper. None if no run has an ATE.
    """
    found = [
        table for table in make_error_tables(outcomes, papers=(), absent=absent) if table.heading == HEADINGS["ate"]
    ]
    if not found:
        return None
    (ate,) = found
    groups = OutcomeGroups(outcomes)
    paper = {variant: f"{PAPER_RATIOS[variant]:.2f}" for variant in ate.methods if variant in PAPER_RATIOS}
    ratios = {
        _RATIO_ROW: tuple(Cell(_ratio_to_full(groups, variant), best=False) for variant in ate.methods),
        f"{_RATIO_ROW} (paper)": tuple(Cell(paper.get(variant, "-"), best=False) for variant in ate.methods),
    }
    return ErrorTable(f"Ablation: {ate.heading}", ate.methods, {**ate.rows, **ratios})


def _ratio_to_full(groups: OutcomeGroups, variant: str) -> str:
    ratios = []
    for sequence in groups.sequences:
        values, full = (collect_metric(groups.of(sequence, config), "ate.rmse") for config in (variant, FULL))
        if values and full:
            ratios.append(median(values) / median(full))
    return f"{geometric_mean(ratios):.2f}" if ratios else "-"


def format_csv(outcomes: Sequence[Outcome]) -> str:
    """Return all outcomes as CSV, one line per run."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["sequence", "variant", "seed", *COLUMNS, "difference", "failure"])
    for run in outcomes:
        metrics = [run.get_metric(key) for key in COLUMNS]
        writer.writerow([run.sequence, run.config, run.seed, *metrics, run.difference, run.failure])
    return text.getvalue()


def conclusion(outcomes: Sequence[Outcome]) -> str:
    """Return a sentence that compares the ATE of the full system on one sequence with that of the best variant.

    Two variants are within noise of each other if their ranges over the seeds overlap. Values are rounded as in the
    table, to 0.1 mm, so smaller differences do not count. The sentence is empty if there is nothing to compare.
    """
    measured = {variant: [round(ate, 4) for ate in ates] for variant, ates in _by_variant(outcomes, "ate.rmse")}
    ates = {variant: values for variant, values in measured.items() if values}
    if FULL not in ates or len(ates) < 2:
        return ""
    best = min(ates, key=lambda variant: (median(ates[variant]), variant != FULL))
    if best == FULL:
        return "No variant is better than the full system."
    if min(ates[FULL]) <= max(ates[best]):
        return f"The full system is within noise of {best}: their ranges over the seeds overlap."
    if len(ates[FULL]) == len(ates[best]) == 1:
        return f"The full system is worse than {best}; with one seed, the difference may be noise."
    return f"The full system is worse than {best}: their ranges over the seeds do not overlap."


def _make_table(outcomes: Sequence[Outcome]) -> ErrorTable:
    """Return the results on one sequence, one row per variant, without the metrics that no run has."""
    headings: list[str] = []
    rows: dict[str, list[Cell]] = {outcome.config: [] for outcome in outcomes}
    for key, column in COLUMNS.items():
        measured = dict(_by_variant(outcomes, key))
        medians = {variant: median(values) for variant, values in measured.items() if values}
        if medians:
            headings.append(column.heading)
            lowest = format(min(medians.values()), column.form)
            for variant, values in measured.items():
                best = column.is_error and bool(values) and format(medians[variant], column.form) == lowest
                rows[variant].append(Cell(format_median_and_range(values, column.form), best))
    failed = {variant: sum(run.failure is not None for run in outcomes if run.config == variant) for variant in rows}
    if any(failed.values()):
        headings.append("failed")
        for variant, count in failed.items():
            rows[variant].append(Cell(str(count), best=False))
    sequence = outcomes[0].sequence
    label = label_sequence(sequence, OutcomeGroups(outcomes).find_difference(sequence))
    return ErrorTable(label, tuple(headings), {variant: tuple(cells) for variant, cells in rows.items()})


def _by_variant(outcomes: Sequence[Outcome], key: str) -> Iterator[tuple[str, list[float]]]:
    """Yield each variant and its values of a metric over the seeds, without the runs in which it was not measured."""
    for variant in dict.fromkeys(outcome.config for outcome in outcomes):
        yield variant, collect_metric([outcome for outcome in outcomes if outcome.config == variant], key)
