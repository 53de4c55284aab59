"""Summary of several runs in the layout of the paper's tables I-III: one row per sequence, one column per method."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from io import StringIO
from statistics import median

from rich.console import RenderableType

from v3d_torch.datasets.sequence_names import find_paper_sequence
from v3d_torch.evaluation.comparison import compare_configurations
from v3d_torch.evaluation.outcome import Outcome, collect_metric, label_sequence
from v3d_torch.evaluation.outcome_groups import OutcomeGroups
from v3d_torch.evaluation.paper_tables import HEADINGS, load_paper_scores
from v3d_torch.evaluation.tables import (
    Cell,
    ErrorTable,
    format_latex_document,
    format_markdown_table,
    format_median_and_range,
    make_screen_legend,
    make_screen_table,
)

METRIC_KEYS: Mapping[str, str] = {"ate": "ate.rmse", "rpe_trans": "rpe.trans.rmse", "rpe_rot": "rpe.rot.rmse"}
"""Key in ``metrics.json`` of each metric of the paper."""

LEGEND = "RMSE, median and [range] over the seeds; RPE over 1 s. The lowest value of a row is bold."
"""Explanation of the tables."""

_ERRORS = {"ate": "ATE", "rpe_trans": "RPE of the translation", "rpe_rot": "RPE of the rotation"}
"""Name of each metric in tables of ratios, which have no unit."""

RATIO_LEGEND = (
    "Ratios: error divided by that of the first configuration with the same sequence and seed: geometric mean and [95 %"
    " interval] over the seeds, or over the sequences. A ratio whose interval does not contain 1 is bold; without a"
    " difference, one of twenty is."
)
"""Explanation of the tables of ratios."""

_RATIO_COLOURS = "Green: errors are smaller; magenta: larger."

_FORMAT = ".4f"
_PAPER_SUFFIX = " (paper)"
_PAPER_NOTE = f"Methods marked{_PAPER_SUFFIX} were not run here: their values are from the paper's tables."
_SCREEN_METHODS = ("ORB-SLAM2", "V3D-SLAM")  # as many of the paper's methods as fit on a screen of 80 columns


def make_error_tables(
    outcomes: Sequence[Outcome], papers: Sequence[str] | None = None, absent: Sequence[str] = ()
) -> list[ErrorTable]:
    """Return one table for each metric that was measured in at least one run.

    Args:
        outcomes: Outcomes of the runs.
        papers: Methods of the paper to include, such as ``V3D-SLAM``; None for all.
        absent: Sequences of the paper that are not available; they have a row without values.
    """
    return list(_error_tables(outcomes, papers, absent))


def make_ratio_tables(outcomes: Sequence[Outcome]) -> list[ErrorTable]:
    """Return one table for each metric in which configurations can be compared; see `compare_configurations`."""
    tables = (compare_configurations(outcomes, METRIC_KEYS[metric], name) for metric, name in _ERRORS.items())
    return [table for table in tables if table is not None]


def format_markdown(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> str:
    """Return a Markdown document with all tables, notes and warnings of the runs, and the runs without scores.

    See `make_error_tables` and `make_ratio_tables`.
    """
    lines = ["# Summary", "", LEGEND]
    tables = make_error_tables(outcomes, absent=absent)
    if any(method.endswith(_PAPER_SUFFIX) for table in tables for method in table.methods):
        lines += ["", _PAPER_NOTE]
    lines += [line for table in tables for line in format_markdown_table(table)]
    if ratios := make_ratio_tables(outcomes):
        lines += [line for table in ratios for line in format_markdown_table(table)]
        lines += ["", RATIO_LEGEND]
    scored = [outcome for outcome in outcomes if outcome.get_metric("ate.rmse") is not None]
    complete = [outcome for outcome in outcomes if outcome.failure is None]
    sections = {
        "Notes": [f"- {outcome.run}: {note}" for outcome in scored for note in outcome.notes],
        "Warnings": [f"- {outcome.run}: {warning}" for outcome in outcomes for warning in outcome.warnings],
        "Not scored": [f"- {outcome}" for outcome in complete if outcome.get_metric("ate.rmse") is None],
        "Failed": [f"- {outcome}" for outcome in outcomes if outcome.failure is not None],
    }
    for title, entries in sections.items():
        lines += ["", f"## {title}", "", *entries] if entries else []
    return "\n".join(lines) + "\n"


def format_latex(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> str:
    """Return all tables as LaTeX, see `make_error_tables`."""
    return format_latex_document(make_error_tables(outcomes, absent=absent), LEGEND)


def format_csv(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> str:
    """Return all values as CSV, unrounded, one line per metric, sequence and method; see `make_error_tables`.

    The column sd is the standard deviation of the errors, as in the paper's tables: the median over the seeds. The last
    column is the difference to the sequence of the benchmark with the same name, if there is one.
    """
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["metric", "sequence", "method", "median", "lowest", "highest", "seeds", "failed", "sd", "difference"]
    )
    groups = OutcomeGroups(outcomes)
    for metric, key in METRIC_KEYS.items():
        for result in _results(groups, metric, None, absent):
            values = result.values
            summary = [median(values), min(values), max(values)] if values else [None] * 3
            counts = [result.seeds, result.failed] if result.seeds else [None] * 2
            deviation = median(result.deviations) if result.deviations else None
            row = [key, result.sequence, result.method, *summary, *counts, deviation, result.difference]
            writer.writerow(row)
    return text.getvalue()


def make_progress_table(outcomes: Sequence[Outcome]) -> ErrorTable | None:
    """Return the first table of `make_screen_tables`, to be shown while runs go on; None if nothing was measured."""
    return next(_screen_error_tables(outcomes, ()), None)


def make_screen_tables(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> list[RenderableType]:
    """Return the tables for the screen, with the first and the last method of the paper, and their explanations.

    See `make_error_tables` and `make_ratio_tables`.
    """
    shown: list[RenderableType] = []
    if errors := list(_screen_error_tables(outcomes, absent)):
        shown += [*map(make_screen_table, errors), make_screen_legend(LEGEND)]
    if ratios := make_ratio_tables(outcomes):
        shown += [*map(make_screen_table, ratios), make_screen_legend(f"{RATIO_LEGEND} {_RATIO_COLOURS}")]
    return shown


@dataclass(frozen=True)
class _Result:
    """One metric of one method on one sequence.

    Attributes:
        sequence: Name of the sequence.
        method: Name of the configuration, or of a method of the paper.
        values: RMSE of each run.
        seeds: Number of runs; 0 for values of the paper, and if the sequence is not available.
        failed: Number of runs that failed.
        absent: True if the sequence is not available.
        deviations: Standard deviation of the errors of each run.
        difference: Difference to the sequence of the benchmark with the same name; None if there is none.
    """

    sequence: str
    method: str
    values: list[float]
    seeds: int = 0
    failed: int = 0
    absent: bool = False
    deviations: Sequence[float] = ()
    difference: str | None = None

    @property
    def text(self) -> str:
        if self.absent:
            return "not here"
        if self.seeds and self.failed == self.seeds:
            return "failed"
        return format_median_and_range(self.values, _FORMAT) + (f", {self.failed} failed" if self.failed else "")


def _error_tables(
    outcomes: Sequence[Outcome], papers: Sequence[str] | None, absent: Sequence[str]
) -> Iterator[ErrorTable]:
    """Yield the tables of `make_error_tables`, each made when it is requested."""
    groups = OutcomeGroups(outcomes)
    for metric, heading in HEADINGS.items():
        results = _results(groups, metric, papers, absent)
        if any(result.seeds and result.values for result in results):
            yield _table(heading, results)


def _screen_error_tables(outcomes: Sequence[Outcome], absent: Sequence[str]) -> Iterator[ErrorTable]:
    for table in _error_tables(outcomes, _SCREEN_METHODS, absent):
        yield replace(table, heading=f"{table.heading}, RMSE")


def _results(groups: OutcomeGroups, metric: str, papers: Sequence[str] | None, absent: Sequence[str]) -> list[_Result]:
    """Collect the results by sequence, then configurations in the order of the runs, then the paper's methods."""
    results = []
    for sequence in _order_sequences(groups.sequences, absent):
        difference = groups.find_difference(sequence)
        for config in groups.configs:
            runs = groups.of(sequence, config)
            failed = sum(run.failure is not None for run in runs)
            values = collect_metric(runs, METRIC_KEYS[metric])
            deviations = collect_metric(runs, METRIC_KEYS[metric].replace("rmse", "std"))
            results.append(
                _Result(sequence, config, values, len(runs), failed, sequence in absent, deviations, difference)
            )
        if (paper_name := find_paper_sequence(sequence)) is not None:
            for method, score in load_paper_scores()[metric][paper_name].items():
                if papers is None or method in papers:
                    values, deviations = ([value] if value is not None else [] for value in score)
                    results.append(_Result(sequence, f"{method}{_PAPER_SUFFIX}", values, deviations=deviations))
    return results


def _order_sequences(sequences: Sequence[str], absent: Sequence[str]) -> list[str]:
    """Return the sequences in the given order; in the paper's order if some of its sequences are absent."""
    if not absent:
        return list(sequences)
    ordered = [sequence for sequence in load_paper_scores()["ate"] if sequence in {*sequences, *absent}]
    return [*ordered, *(sequence for sequence in sequences if sequence not in ordered)]


def _table(heading: str, results: Sequence[_Result]) -> ErrorTable:
    methods = tuple(dict.fromkeys(result.method for result in results))
    by_sequence: dict[str, dict[str, _Result]] = {}
    for result in results:
        by_sequence.setdefault(result.sequence, {})[result.method] = result
    rows = {}
    for sequence, by_method in by_sequence.items():
        medians = {method: median(result.values) for method, result in by_method.items() if result.values}
        difference = next((result.difference for result in by_method.values() if result.difference is not None), None)
        # A part of a sequence, or another recording, is not comparable with the whole, so no value is the best.
        is_comparable = len(medians) > 1 and difference is None
        lowest = format(min(medians.values()), _FORMAT) if is_comparable else None
        rows[label_sequence(sequence, difference)] = tuple(
            Cell(
                by_method[method].text if method in by_method else "-",
                best=method in medians and format(medians[method], _FORMAT) == lowest,
            )
            for method in methods
        )
    return ErrorTable(heading, methods, rows)
