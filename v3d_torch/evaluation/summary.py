"""Several runs in the layout of the paper's tables I-III: a row per sequence, a column per method."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from statistics import median

from rich import box
from rich.markup import escape
from rich.table import Table

from v3d_torch.evaluation.cells import Cell, row, shown_lowest, spread
from v3d_torch.evaluation.outcome import Outcome, values_of
from v3d_torch.evaluation.tables import HEADINGS, paper_scores, paper_sequence

PLACES: Mapping[str, str] = {"ate": "ate.rmse", "rpe_trans": "rpe.trans.rmse", "rpe_rot": "rpe.rot.rmse"}
"""Where ``metrics.json`` has each of the paper's metrics."""

_FORM = ".4f"
_LEGEND = "RMSE, median and [range] over the seeds; RPE over 1 s. The lowest of a row is bold."
_PAPERS = "Methods marked (paper) are not run here: these are the figures of the paper's tables."


@dataclass(frozen=True)
class ErrorTable:
    """One metric of all runs.

    Attributes:
        heading: the metric and its unit.
        methods: headings of the columns: configurations, then the paper's methods where a sequence is one of its.
        rows: a cell per method for each sequence; the lowest of the row, as shown, is the best.
    """

    heading: str
    methods: tuple[str, ...]
    rows: Mapping[str, tuple[Cell, ...]]


def error_tables(outcomes: Sequence[Outcome], papers: Sequence[str] | None = None) -> list[ErrorTable]:
    """The tables of all metrics that at least one run has.

    Args:
        outcomes: of the runs.
        papers: the paper's methods to set beside, such as ``V3D-SLAM``; None for all.
    """
    tables = []
    for metric, heading in HEADINGS.items():
        results = _results(outcomes, metric, papers)
        if any(result.seeds and result.values for result in results):
            tables.append(_table(heading, results))
    return tables


def markdown(outcomes: Sequence[Outcome]) -> str:
    """All tables as a document, with the runs that failed below."""
    lines = ["# Summary", "", _LEGEND]
    tables = error_tables(outcomes)
    if any(_is_papers(method) for table in tables for method in table.methods):
        lines += ["", _PAPERS]
    for table in tables:
        columns = ["sequence", *table.methods]
        lines += ["", f"## {table.heading}", "", row(columns), row(["---", *["---:"] * len(table.methods)])]
        for sequence, cells in table.rows.items():
            lines.append(row([sequence, *(f"**{cell.text}**" if cell.best else cell.text for cell in cells)]))
    failed = [f"- {outcome}" for outcome in outcomes if outcome.failure is not None]
    lines += ["", "## Failed", "", *failed] if failed else []
    return "\n".join(lines) + "\n"


def latex(outcomes: Sequence[Outcome]) -> str:
    """All tables for a paper; they need the package booktabs."""
    lines = ["% \\usepackage{booktabs}"]
    for table in error_tables(outcomes):
        lines += [
            "\\begin{table*}",
            "  \\centering",
            f"  \\caption{{{_tex(table.heading)}. {_tex(_LEGEND)}}}",
            f"  \\begin{{tabular}}{{l{'r' * len(table.methods)}}}",
            "    \\toprule",
            f"    {_tex_row(['Sequence', *map(_tex, table.methods)])}",
            "    \\midrule",
        ]
        for sequence, cells in table.rows.items():
            texts = [_tex(cell.text).replace("-", "--") for cell in cells]
            bold = [f"\\textbf{{{t}}}" if cell.best else t for t, cell in zip(texts, cells, strict=True)]
            lines.append(f"    {_tex_row([_tex(sequence), *bold])}")
        lines += ["    \\bottomrule", "  \\end{tabular}", "\\end{table*}"]
    return "\n".join(lines) + "\n"


def csv_text(outcomes: Sequence[Outcome]) -> str:
    """All figures, unrounded, a line per metric, sequence and method."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["metric", "sequence", "method", "median", "lowest", "highest", "seeds", "failed"])
    for metric, place in PLACES.items():
        for result in _results(outcomes, metric, None):
            values = result.values
            figures = [median(values), min(values), max(values)] if values else [None] * 3
            counts = [result.seeds, result.failed] if result.seeds else [None] * 2
            writer.writerow([place, result.sequence, result.method, *figures, *counts])
    return text.getvalue()


def screen_tables(outcomes: Sequence[Outcome]) -> list[Table]:
    """The tables for the screen, of the paper's methods only the first and the last, the best in green."""
    tables = []
    for table in error_tables(outcomes, papers=("ORB-SLAM2", "V3D-SLAM")):
        shown = Table(title=f"{table.heading}, RMSE", box=box.SIMPLE_HEAD)
        shown.add_column("sequence", no_wrap=True)
        for method in table.methods:
            shown.add_column(escape(method).replace(" (", "\n("), justify="right", overflow="fold")
        for sequence, cells in table.rows.items():
            # The range below the median, and the failures below that.
            texts = [escape(cell.text.replace(" [", "\n[").replace(", ", ",\n")) for cell in cells]
            marked = [f"[bold green]{t}[/]" if cell.best else t for t, cell in zip(texts, cells, strict=True)]
            shown.add_row(escape(sequence), *marked)
        tables.append(shown)
    return tables


@dataclass(frozen=True)
class _Result:
    """One metric of a method on a sequence; ``seeds`` is 0 for what the paper says."""

    sequence: str
    method: str
    values: list[float]
    seeds: int = 0
    failed: int = 0

    @property
    def text(self) -> str:
        if self.seeds and self.failed == self.seeds:
            return "failed"
        return spread(self.values, _FORM) + (f", {self.failed} failed" if self.failed else "")


def _results(outcomes: Sequence[Outcome], metric: str, papers: Sequence[str] | None) -> list[_Result]:
    """By sequence, then configurations in the order of the runs, then the paper's methods."""
    results = []
    configs = dict.fromkeys(outcome.config for outcome in outcomes)
    for sequence in dict.fromkeys(outcome.sequence for outcome in outcomes):
        for config in configs:
            runs = [run for run in outcomes if (run.sequence, run.config) == (sequence, config)]
            failed = sum(run.failure is not None for run in runs)
            results.append(_Result(sequence, config, values_of(runs, PLACES[metric]), len(runs), failed))
        if (named := paper_sequence(sequence)) is not None:
            for method, score in paper_scores()[metric][named].items():
                if papers is None or method in papers:
                    values = [score.rmse] if score.rmse is not None else []
                    results.append(_Result(sequence, f"{method} (paper)", values))
    return results


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


_SPECIAL = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"[": "{[}"}  # at the head of a row it would belong to the end of the last one
)


def _tex(text: str) -> str:
    return text.translate(_SPECIAL)


def _tex_row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"
