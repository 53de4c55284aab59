"""Tables that compare several runs, as Markdown, as LaTeX and for the screen."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from statistics import median
from typing import NamedTuple

from rich import box
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from v3d_torch.io.text import shorten

_MAX_SCREEN_NAME = 40
"""Maximum number of characters of a name on the screen, so that one long name does not widen all rows; the middle of a
longer one is left out."""

_MAX_ROWS_OF_A_PAGE = 40
"""Number of rows above which a LaTeX table breaks across pages."""

_LAST_PDFLATEX_LETTER = "\u017f"
"""Last letter of Latin Extended-A: pdfLaTeX has no characters of other scripts."""


class Cell(NamedTuple):
    """Cell of a table.

    Attributes:
        text: Text of the cell.
        best: True if the value is the best of the compared values, or significantly better than a reference.
        worse: True if it is significantly worse than the reference.
    """

    text: str
    best: bool
    worse: bool = False

    @property
    def is_bold(self) -> bool:
        """True if the cell is bold where tables have no colours."""
        return self.best or self.worse

    @property
    def style(self) -> str:
        """Style on the screen. Colour-blind people can tell green and magenta apart, but not green and red."""
        return "bold green" if self.best else "bold magenta" if self.worse else ""


@dataclass(frozen=True)
class ErrorTable:
    """Table of one metric, or of all metrics on one sequence.

    Attributes:
        heading: Name and unit of the metric, or name of the sequence.
        methods: Column headings: the configurations, then the methods of the paper; or the metrics.
        rows: For each sequence, one cell per method. The lowest value of a row, as printed, is the best. Or for each
            configuration, one cell per metric, and the best value of a column.
    """

    heading: str
    methods: tuple[str, ...]
    rows: Mapping[str, tuple[Cell, ...]]


def select_last_rows(table: ErrorTable, count: int) -> ErrorTable:
    """Return the last rows of a table; the first row then tells how many others there are."""
    omitted = len(table.rows) - count
    if omitted <= 0:
        return table
    blank = Cell("", best=False)
    first = {f"... {omitted} more": (blank,) * len(table.methods)}
    return replace(table, rows=first | dict(islice(table.rows.items(), omitted, None)))


def format_median_and_range(values: Sequence[float], form: str) -> str:
    """Format the median of values, followed by their range unless all print the same.

    Args:
        values: Values of the runs, in any order; a dash is returned if there are none.
        form: Format of a value, such as ``.4f``.
    """
    if not values:
        return "-"
    middle, low, high = (format(value, form) for value in (median(values), min(values), max(values)))
    return middle if low == high else f"{middle} [{low}-{high}]"


def make_screen_legend(legend: str) -> Padding:
    """Return the explanation of tables for the screen, wrapped at spaces also on a console that does not wrap."""
    return Padding(Text(legend, no_wrap=False, overflow="fold"), (0, 0, 1, 0), expand=False)


def markdown_row(cells: Sequence[str]) -> str:
    """Format a row of a Markdown table."""
    return f"| {' | '.join(map(_escape_markdown, cells))} |"


def format_markdown_table(table: ErrorTable, first_heading: str = "sequence", note: str = "") -> list[str]:
    """Return the lines of a Markdown section with the table, marked values in bold.

    Args:
        table: Table.
        first_heading: Heading of the column with the names of the rows.
        note: Text above the table.
    """
    lines = ["", f"## {_escape_markdown(table.heading)}", *([note] if note else []), ""]
    lines.append(markdown_row([first_heading, *table.methods]))
    lines.append(markdown_row(["---", *["---:"] * len(table.methods)]))
    for name, cells in table.rows.items():
        lines.append(markdown_row([name, *(f"**{cell.text}**" if cell.is_bold else cell.text for cell in cells)]))
    return lines


def format_latex_document(tables: Sequence[ErrorTable], legend: str) -> str:
    """Return tables as LaTeX, marked values in bold; the first lines are comments with the packages they require.

    Args:
        tables: Tables.
        legend: Explanation in each caption.
    """
    lines = [line for table in tables for line in _latex_table(table, legend)]
    head = ["% \\usepackage{booktabs}"]
    if any(_is_long(table) for table in tables):
        head.append("% \\usepackage{longtable}, whose tables break across pages, in documents with one column")
    if any(character > _LAST_PDFLATEX_LETTER for line in lines for character in line):
        head.append("% XeLaTeX or LuaLaTeX, and a font (\\setmainfont of fontspec) with all characters of the names")
    return "\n".join([*head, *lines]) + "\n"


def _latex_table(table: ErrorTable, legend: str) -> list[str]:
    caption = f"\\caption{{{_escape_latex(table.heading)}. {_escape_latex(legend)}}}"
    columns = "l" + "r" * len(table.methods)
    head = ["\\toprule", _latex_row(["Sequence", *map(_escape_latex, table.methods)]), "\\midrule"]
    rows = []
    for sequence, cells in table.rows.items():
        texts = [_escape_latex(cell.text).replace("-", "--") for cell in cells]
        bold = [f"\\textbf{{{t}}}" if cell.is_bold else t for t, cell in zip(texts, cells, strict=True)]
        rows.append(_latex_row([_escape_latex(sequence), *bold]))
    if _is_long(table):
        repeated = [*head, "\\endfirsthead", *head, "\\endhead", "\\bottomrule", "\\endfoot"]
        content = [f"{caption} \\\\", *repeated, *rows]
        return [f"\\begin{{longtable}}{{{columns}}}", *(f"  {line}" for line in content), "\\end{longtable}"]
    return [
        "\\begin{table*}",
        "  \\centering",
        f"  {caption}",
        f"  \\begin{{tabular}}{{{columns}}}",
        *(f"    {line}" for line in [*head, *rows, "\\bottomrule"]),
        "  \\end{tabular}",
        "\\end{table*}",
    ]


def _is_long(table: ErrorTable) -> bool:
    return len(table.rows) > _MAX_ROWS_OF_A_PAGE


def make_screen_table(table: ErrorTable, first_heading: str = "sequence", note: str = "") -> Table:
    """Return the table for the screen, the best values in green, and those that are significantly worse in magenta.

    Args:
        table: Table.
        first_heading: Heading of the column with the names of the rows.
        note: Text below the table.
    """
    shown = Table(title=escape(table.heading), caption=note or None, box=box.SIMPLE_HEAD)
    shown.add_column(first_heading, no_wrap=True)
    for method in table.methods:
        shown.add_column(escape(method).replace(" (", "\n("), justify="right", overflow="fold")
    for name, cells in table.rows.items():
        # Put the range below the median, and the number of failed runs below the range.
        texts = [escape(cell.text.replace(" [", "\n[").replace(", ", ",\n")) for cell in cells]
        marked = [f"[{cell.style}]{t}[/]" if cell.style else t for t, cell in zip(texts, cells, strict=True)]
        lines = [shorten(line, _MAX_SCREEN_NAME) for line in name.replace(" (", "\n(").split("\n")]
        shown.add_row(escape("\n".join(lines)), *marked)
    return shown


def _escape_markdown(text: str) -> str:
    """Escape what would end a cell, or begin an element or a character of HTML: names can contain it."""
    return re.sub(r"[|<]|&(?=#?\w+;)", r"\\\g<0>", text)


_LATEX_ESCAPES = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"[": "{[}"}  # a bracket at the start of a row would be the optional argument of the previous "\\"
)


def _escape_latex(text: str) -> str:
    return text.translate(_LATEX_ESCAPES)


def _latex_row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"
