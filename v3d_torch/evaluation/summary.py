"""Several runs in the layout of the paper's tables I-III: a row per sequence, a column per method."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from statistics import median

from rich.table import Table

from v3d_torch.evaluation.cells import Cell, shown_lowest, spread
from v3d_torch.evaluation.layout import ErrorTable, latex_table, markdown_table, screen_table
from v3d_torch.evaluation.outcome import Outcome, values_of
from v3d_torch.evaluation.tables import HEADINGS, paper_scores, paper_sequence

PLACES: Mapping[str, str] = {"ate": "ate.rmse", "rpe_trans": "rpe.trans.rmse", "rpe_rot": "rpe.rot.rmse"}
"""Where ``metrics.json`` has each of the paper's metrics."""

_FORM = ".4f"
LEGEND = "RMSE, median and [range] over the seeds; RPE over 1 s. The lowest of a row is bold."
"""What is to be known to read the tables."""

PACKAGES = "% \\usepackage{booktabs}"
"""First line of a file of tables in LaTeX."""

_PAPERS = "Methods marked (paper) are not run here: these are the figures of the paper's tables."


def error_tables(
    outcomes: Sequence[Outcome], papers: Sequence[str] | None = None, absent: Sequence[str] = ()
) -> list[ErrorTable]:
    """The tables of all metrics that at least one run has.

    Args:
        outcomes: of the runs.
        papers: the paper's methods to set beside, such as ``V3D-SLAM``; None for all.
        absent: sequences of the paper that nothing could be run on, but that have their row.
    """
    tables = []
    for metric, heading in HEADINGS.items():
        results = _results(outcomes, metric, papers, absent)
        if any(result.seeds and result.values for result in results):
            tables.append(_table(heading, results))
    return tables


def markdown(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> str:
    """All tables as a document, with the runs that failed below; see `error_tables`."""
    lines = ["# Summary", "", LEGEND]
    tables = error_tables(outcomes, absent=absent)
    if any(_is_papers(method) for table in tables for method in table.methods):
        lines += ["", _PAPERS]
    lines += [line for table in tables for line in markdown_table(table)]
    failed = [f"- {outcome}" for outcome in outcomes if outcome.failure is not None]
    lines += ["", "## Failed", "", *failed] if failed else []
    return "\n".join(lines) + "\n"


def latex(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> str:
    """All tables for a paper; they need the package booktabs; see `error_tables`."""
    tables = error_tables(outcomes, absent=absent)
    lines = [PACKAGES, *(line for table in tables for line in latex_table(table, LEGEND))]
    return "\n".join(lines) + "\n"


def csv_text(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> str:
    """All figures, unrounded, a line per metric, sequence and method; see `error_tables`.

    The last column is the standard deviation that the paper gives as well: the median over the seeds.
    """
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["metric", "sequence", "method", "median", "lowest", "highest", "seeds", "failed", "sd"])
    for metric, place in PLACES.items():
        for result in _results(outcomes, metric, None, absent):
            values = result.values
            figures = [median(values), min(values), max(values)] if values else [None] * 3
            counts = [result.seeds, result.failed] if result.seeds else [None] * 2
            deviation = median(result.deviations) if result.deviations else None
            writer.writerow([place, result.sequence, result.method, *figures, *counts, deviation])
    return text.getvalue()


def screen_tables(outcomes: Sequence[Outcome], absent: Sequence[str] = ()) -> list[Table]:
    """The tables for the screen, of the paper's methods only the first and the last; see `error_tables`."""
    return [screen_table(table) for table in error_tables(outcomes, ("ORB-SLAM2", "V3D-SLAM"), absent)]


@dataclass(frozen=True)
class _Result:
    """One metric of a method on a sequence; ``seeds`` is 0 for what the paper says and where there is no sequence.

    ``values`` are root mean squares, ``deviations`` the standard deviations of the same errors.
    """

    sequence: str
    method: str
    values: list[float]
    seeds: int = 0
    failed: int = 0
    absent: bool = False
    deviations: Sequence[float] = ()

    @property
    def text(self) -> str:
        if self.absent:
            return "not here"
        if self.seeds and self.failed == self.seeds:
            return "failed"
        return spread(self.values, _FORM) + (f", {self.failed} failed" if self.failed else "")


def _results(
    outcomes: Sequence[Outcome], metric: str, papers: Sequence[str] | None, absent: Sequence[str]
) -> list[_Result]:
    """By sequence, then configurations in the order of the runs, then the paper's methods."""
    results = []
    configs = dict.fromkeys(outcome.config for outcome in outcomes)
    for sequence in _in_order([outcome.sequence for outcome in outcomes], absent):
        for config in configs:
            runs = [run for run in outcomes if (run.sequence, run.config) == (sequence, config)]
            failed = sum(run.failure is not None for run in runs)
            values = values_of(runs, PLACES[metric])
            sds = values_of(runs, PLACES[metric].replace("rmse", "std"))
            results.append(_Result(sequence, config, values, len(runs), failed, sequence in absent, sds))
        if (named := paper_sequence(sequence)) is not None:
            for method, score in paper_scores()[metric][named].items():
                if papers is None or method in papers:
                    values, sds = ([figure] if figure is not None else [] for figure in score)
                    results.append(_Result(sequence, f"{method} (paper)", values, deviations=sds))
    return results


def _in_order(sequences: Sequence[str], absent: Sequence[str]) -> list[str]:
    """Each once: as they come; where some of the paper's are absent, in the order of its tables."""
    if not absent:
        return list(dict.fromkeys(sequences))
    return [sequence for sequence in paper_scores()["ate"] if sequence in {*sequences, *absent}]


def _table(heading: str, results: Sequence[_Result]) -> ErrorTable:
    methods = tuple(dict.fromkeys(result.method for result in results))
    rows = {}
    for sequence in dict.fromkeys(result.sequence for result in results):
        of_row = {result.method: result for result in results if result.sequence == sequence}
        medians = {method: median(result.values) for method, result in of_row.items() if result.values}
        lowest = shown_lowest(medians.values(), _FORM) if len(medians) > 1 else None
        rows[sequence] = tuple(
            Cell(
                of_row[method].text if method in of_row else "-",
                best=method in medians and format(medians[method], _FORM) == lowest,
            )
            for method in methods
        )
    return ErrorTable(heading, methods, rows)


def _is_papers(method: str) -> bool:
    return method.endswith(" (paper)")
