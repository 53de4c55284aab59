"""A table of one error as Markdown, as LaTeX and for the screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich import box
from rich.markup import escape
from rich.table import Table

from v3d_torch.evaluation.cells import Cell, row


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


def markdown_table(table: ErrorTable) -> list[str]:
    """Lines of a section of a document, the best in bold."""
    lines = ["", f"## {table.heading}", "", row(["sequence", *table.methods])]
    lines.append(row(["---", *["---:"] * len(table.methods)]))
    for sequence, cells in table.rows.items():
        lines.append(row([sequence, *(f"**{cell.text}**" if cell.best else cell.text for cell in cells)]))
    return lines


def latex_table(table: ErrorTable, legend: str) -> list[str]:
    """Lines of a table for a paper, the best in bold; it needs the package booktabs."""
    lines = [
        "\\begin{table*}",
        "  \\centering",
        f"  \\caption{{{_tex(table.heading)}. {_tex(legend)}}}",
        f"  \\begin{{tabular}}{{l{'r' * len(table.methods)}}}",
        "    \\toprule",
        f"    {_tex_row(['Sequence', *map(_tex, table.methods)])}",
        "    \\midrule",
    ]
    for sequence, cells in table.rows.items():
        texts = [_tex(cell.text).replace("-", "--") for cell in cells]
        bold = [f"\\textbf{{{t}}}" if cell.best else t for t, cell in zip(texts, cells, strict=True)]
        lines.append(f"    {_tex_row([_tex(sequence), *bold])}")
    return [*lines, "    \\bottomrule", "  \\end{tabular}", "\\end{table*}"]


def screen_table(table: ErrorTable) -> Table:
    """The table for the screen, the best in green."""
    shown = Table(title=f"{table.heading}, RMSE", box=box.SIMPLE_HEAD)
    shown.add_column("sequence", no_wrap=True)
    for method in table.methods:
        shown.add_column(escape(method).replace(" (", "\n("), justify="right", overflow="fold")
    for sequence, cells in table.rows.items():
        # The range below the median, and the failures below that.
        texts = [escape(cell.text.replace(" [", "\n[").replace(", ", ",\n")) for cell in cells]
        marked = [f"[bold green]{t}[/]" if cell.best else t for t, cell in zip(texts, cells, strict=True)]
        shown.add_row(escape(sequence), *marked)
    return shown


_SPECIAL = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"[": "{[}"}  # at the head of a row it would belong to the end of the last one
)


def _tex(text: str) -> str:
    return text.translate(_SPECIAL)


def _tex_row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"
