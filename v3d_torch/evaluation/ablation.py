"""The ablation study (paper, Sec. IV-D): its variants, what their runs gave, and the tables of that."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from statistics import median
from typing import Any, NamedTuple

from rich.markup import escape
from rich.table import Table

from v3d_torch.evaluation.cells import row, spread

FULL = "full"

VARIANTS: Mapping[str, tuple[str, ...]] = {
    "baseline": ("segmentation.source=none",),
    "no_voting": ("objects.voting.enabled=false",),
    "no_chamfer": ("objects.chamfer.enabled=false",),
    "no_bridging": ("objects.identity.max_gap=0",),
    "no_unnamed": ("objects.background.min_area=.inf",),
    "as_held": ("segmentation.upright=false",),
    "paper": (
        "segmentation.upright=false",
        "objects.voting.baselines=[0.0]",
        "objects.background.enabled=false",
        "objects.chamfer.baseline=0.0",
        "objects.mask.confirm_still=0.0",
        "objects.mask.hold_dynamic=0.0",
    ),
    FULL: (),
}
"""What each variant sets otherwise than the defaults. The checkout has the same as files, for ``run --config``."""

LEGEND = (
    "Median and [range] over the seeds. ATE and RPE (over 1 s): RMSE; SD: of the ATE. Moving out, static out: share of"
    " the truly moving and static pixels with depth that tracking did not use; id changes: of a person in view, in 60"
    " frames; found: share of the frames in view in which an object covers the person."
)
PAPER_SAYS = (
    "The paper (Sec. IV-D) gives no table but says of the ATE: without voting 8 % better than the baseline and four"
    " times that of the full system; without the intra-object stage (Chamfer) 6 % worse than the full system."
)


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


@dataclass(frozen=True)
class Outcome:
    """What one run gave.

    Attributes:
        sequence: name.
        variant: a key of `VARIANTS`.
        seed: of the run.
        metrics: as in its ``metrics.json``; empty where it failed.
        failure: the sentence that it failed with; None where it did not.
    """

    sequence: str
    variant: str
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
        return f"{self.sequence}, {self.variant}, seed {self.seed}: {result}"


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


def markdown(outcomes: Sequence[Outcome]) -> str:
    """All outcomes as a document: a table for each sequence, the best of each error in bold, and what failed."""
    lines = [
        "# Ablation",
        LEGEND,
        "",
        PAPER_SAYS,
        "",
        "The network ran once for each sequence and all runs were in one process: the times and the memory in their"
        " metrics.json are not those of a run alone.",
    ]
    for sequence in dict.fromkeys(outcome.sequence for outcome in outcomes):
        runs = [outcome for outcome in outcomes if outcome.sequence == sequence]
        headings, rows = _summary(runs)
        lines += ["", f"## {sequence}", f"Seeds: {len({run.seed for run in runs})}. {verdict(runs)}", ""]
        lines += [row(["variant", *headings]), row(["---", *["---:"] * len(headings)])]
        for variant, cells in rows.items():
            lines.append(row([variant, *(f"**{cell.text}**" if cell.best else cell.text for cell in cells)]))
        lines += ["", *(f"- {run}" for run in runs if run.failure is not None)]
    return "\n".join(lines) + "\n"


def csv_text(outcomes: Sequence[Outcome]) -> str:
    """All outcomes, a line for each run."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["sequence", "variant", "seed", *COLUMNS, "failure"])
    for run in outcomes:
        writer.writerow([run.sequence, run.variant, run.seed, *(run.figure(place) for place in COLUMNS), run.failure])
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


class _Cell(NamedTuple):
    text: str
    best: bool


def _summary(outcomes: Sequence[Outcome]) -> tuple[list[str], dict[str, list[_Cell]]]:
    """Headings and a row of cells for each variant; figures that no run has are left out."""
    headings: list[str] = []
    rows: dict[str, list[_Cell]] = {outcome.variant: [] for outcome in outcomes}
    for place, column in COLUMNS.items():
        measured = dict(_by_variant(outcomes, place))
        medians = {variant: median(values) for variant, values in measured.items() if values}
        if medians:
            headings.append(column.heading)
            lowest = format(min(medians.values()), column.form)
            for variant, values in measured.items():
                best = column.is_error and bool(values) and format(medians[variant], column.form) == lowest
                rows[variant].append(_Cell(spread(values, column.form), best))
    failed = {variant: sum(run.failure is not None for run in outcomes if run.variant == variant) for variant in rows}
    if any(failed.values()):
        headings.append("failed")
        for variant, count in failed.items():
            rows[variant].append(_Cell(str(count), best=False))
    return headings, rows


def _by_variant(outcomes: Sequence[Outcome], place: str) -> Iterator[tuple[str, list[float]]]:
    """Variant and the values of a figure over the seeds, without those not measured."""
    for variant in dict.fromkeys(outcome.variant for outcome in outcomes):
        values = [outcome.figure(place) for outcome in outcomes if outcome.variant == variant]
        yield variant, [value for value in values if value is not None]
