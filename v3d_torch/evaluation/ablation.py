"""The ablation study (paper, Sec. IV-D): its variants, what their runs gave, and the tables of that."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from statistics import geometric_mean, median
from typing import NamedTuple

from rich.markup import escape
from rich.table import Table

from v3d_torch.config.loading import FULL
from v3d_torch.evaluation.cells import Cell, row, shown_lowest, spread
from v3d_torch.evaluation.layout import ErrorTable
from v3d_torch.evaluation.outcome import Outcome, values_of
from v3d_torch.evaluation.summary import error_tables
from v3d_torch.evaluation.tables import HEADINGS

VARIANTS = (
    "baseline",
    "no_voting",
    "no_chamfer",
    "no_prediction",
    "no_unlabelled",
    "not_upright",
    "global_shutter",
    "paper",
    FULL,
)
"""Names of the configurations that are compared (`v3d_torch.config.loading.CONFIGS`), the whole system last."""

LEGEND = (
    "Median and [range] over the seeds. ATE and RPE (over 1 s): RMSE; SD: of the ATE. Moving out, static out: share of"
    " the truly moving and static pixels with depth that tracking did not use; id changes: of a person in view, in 60"
    " frames; found: share of the frames in view in which an object covers the person."
)
PAPER_SAYS = (
    "The paper (Sec. IV-D) gives no table but says of the ATE: without voting 8 % better than the baseline and four"
    " times that of the full system; without the intra-object stage (Chamfer) 6 % worse than the full system."
)

PAPER_TIMES_FULL: Mapping[str, float] = {"baseline": 4 / 0.92, "no_voting": 4.0, "no_chamfer": 1.06, FULL: 1.0}
"""How many times the full system's ATE a variant has, by what the paper says."""

TIMES_FULL = (
    "Times full: the ATE as a multiple of the full system's, geometric mean over the sequences that both were run on;"
    " (paper): by what it says."
)
"""What is to be known to read the last rows of `overview`."""


class Column(NamedTuple):
    """A figure of the tables: its heading, how a value is written, and whether it is an error, the lowest the best."""

    heading: str
    form: str
    is_error: bool


COLUMNS: Mapping[str, Column] = {
    "ate.rmse": Column("ATE, m", ".4f", True),
    "ate.std": Column("SD, m", ".4f", True),
    "rpe.trans.rmse": Column("RPE, m/s", ".4f", True),
    "rpe.rot.rmse": Column("RPE, deg/s", ".3f", True),
    # Leaving out everything, or nobody, is no merit: of these none is marked as the best.
    "masks.moving_left_out": Column("moving out", ".1%", False),
    "masks.static_left_out": Column("static out", ".1%", False),
    "masks.id_changes_per_60_frames": Column("id changes", ".2f", False),
    "masks.people_found": Column("found", ".0%", False),
}
"""By the figure's place in ``metrics.json``."""


def screen_table(outcomes: Sequence[Outcome]) -> Table:
    """The outcomes on one sequence for the screen, a row per variant, the best of each error in green."""
    headings, rows = _summary(outcomes)
    table = Table(title=f"Ablation on {escape(outcomes[0].sequence)}", caption=verdict(outcomes))
    table.add_column("variant", no_wrap=True)
    for heading in headings:
        table.add_column(heading, justify="right", overflow="fold")
    for variant, cells in rows.items():
        texts = [cell.text.replace(" ", "\n") for cell in cells]  # the range below the median
        table.add_row(variant, *(f"[green]{t}[/]" if c.best else t for t, c in zip(texts, cells, strict=True)))
    return table


def markdown(outcomes: Sequence[Outcome], note: str = "") -> str:
    """All outcomes as a document: a table for each sequence, the best of each error in bold, and what failed.

    Args:
        outcomes: of the runs.
        note: on how they were made.
    """
    lines = ["# Ablation", LEGEND, "", PAPER_SAYS, "", *([note] if note else [])]
    for sequence in dict.fromkeys(outcome.sequence for outcome in outcomes):
        runs = [outcome for outcome in outcomes if outcome.sequence == sequence]
        headings, rows = _summary(runs)
        lines += ["", f"## {sequence}", f"Seeds: {len({run.seed for run in runs})}. {verdict(runs)}", ""]
        lines += [row(["variant", *headings]), row(["---", *["---:"] * len(headings)])]
        for variant, cells in rows.items():
            lines.append(row([variant, *(f"**{cell.text}**" if cell.best else cell.text for cell in cells)]))
        lines += ["", *(f"- {run}" for run in runs if run.failure is not None)]
    return "\n".join(lines) + "\n"


def overview(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> ErrorTable | None:
    """The ATE of all variants on all sequences, and how many times the full system's that is, beside the paper's word.

    Args:
        outcomes: of the runs.
        absent: sequences of the paper that nothing could be run on, but that have their row.

    Returns:
        A column per variant. The last rows are the geometric mean, over the sequences that have both, of the ratio to
        the full system's, and what the paper says of it. None where no run has an ATE.
    """
    tables = [table for table in error_tables(outcomes, papers=(), absent=absent) if table.heading == HEADINGS["ate"]]
    if not tables:
        return None
    (ate,) = tables
    paper = {variant: f"{PAPER_TIMES_FULL[variant]:.2f}" for variant in ate.methods if variant in PAPER_TIMES_FULL}
    times = {
        "times full": tuple(Cell(_times_full(outcomes, variant), best=False) for variant in ate.methods),
        "times full (paper)": tuple(Cell(paper.get(variant, "-"), best=False) for variant in ate.methods),
    }
    return ErrorTable(f"Ablation: {ate.heading}", ate.methods, {**ate.rows, **times})


def _times_full(outcomes: Sequence[Outcome], variant: str) -> str:
    ratios = []
    for sequence in dict.fromkeys(outcome.sequence for outcome in outcomes):
        measured = dict(_by_variant([run for run in outcomes if run.sequence == sequence], "ate.rmse"))
        values, full = measured.get(variant), measured.get(FULL)
        if values and full:
            ratios.append(median(values) / median(full))
    return f"{geometric_mean(ratios):.2f}" if ratios else "-"


def csv_text(outcomes: Sequence[Outcome]) -> str:
    """All outcomes, a line for each run."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["sequence", "variant", "seed", *COLUMNS, "failure"])
    for run in outcomes:
        writer.writerow([run.sequence, run.config, run.seed, *(run.figure(place) for place in COLUMNS), run.failure])
    return text.getvalue()


def verdict(outcomes: Sequence[Outcome]) -> str:
    """Whether the full system's ATE is the best on one sequence, or at least within noise of it.

    Within noise is a variant whose range over the seeds overlaps the best one's. What the table does not show, less
    than 0.1 mm, is no difference.
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
        return f"The full system is worse than {best}; one seed does not tell whether by more than noise."
    return f"The full system is worse than {best}: their ranges over the seeds do not overlap."


def _summary(outcomes: Sequence[Outcome]) -> tuple[list[str], dict[str, list[Cell]]]:
    """Headings and a row of cells for each variant; figures that no run has are left out."""
    headings: list[str] = []
    rows: dict[str, list[Cell]] = {outcome.config: [] for outcome in outcomes}
    for place, column in COLUMNS.items():
        measured = dict(_by_variant(outcomes, place))
        medians = {variant: median(values) for variant, values in measured.items() if values}
        if medians:
            headings.append(column.heading)
            lowest = shown_lowest(medians.values(), column.form)
            for variant, values in measured.items():
                best = column.is_error and bool(values) and format(medians[variant], column.form) == lowest
                rows[variant].append(Cell(spread(values, column.form), best))
    failed = {variant: sum(run.failure is not None for run in outcomes if run.config == variant) for variant in rows}
    if any(failed.values()):
        headings.append("failed")
        for variant, count in failed.items():
            rows[variant].append(Cell(str(count), best=False))
    return headings, rows


def _by_variant(outcomes: Sequence[Outcome], place: str) -> Iterator[tuple[str, list[float]]]:
    """Variant and the values of a figure over the seeds, without those not measured."""
    for variant in dict.fromkeys(outcome.config for outcome in outcomes):
        yield variant, values_of([outcome for outcome in outcomes if outcome.config == variant], place)
