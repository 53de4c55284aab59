"""Summary of a batch in the layout of the paper's tables: Markdown, LaTeX, CSV and screen."""

from __future__ import annotations

import csv
import os
import re
from dataclasses import replace
from io import StringIO
from typing import Any

import pytest
from rich.console import Console
from rich.text import Text

from v3d_torch.datasets import PAPER_SEQUENCES, short_name
from v3d_torch.evaluation.outcome import Outcome, label_sequence
from v3d_torch.evaluation.paper_tables import load_paper_scores
from v3d_torch.evaluation.summary import (
    format_csv,
    format_latex,
    format_markdown,
    make_error_tables,
    make_screen_tables,
)


def runs(sequence: str, config: str, *ates: float | None) -> list[Outcome]:
    """Outcomes with given ATE; RPE is 0.1 and 100 times the ATE. None stands for a failed run."""

    def metrics(ate: float | None) -> dict[str, Any]:
        if ate is None:
            return {}
        return {"ate": {"rmse": ate, "std": ate / 2}, "rpe": {"trans": {"rmse": ate / 10}, "rot": {"rmse": ate * 100}}}

    return [
        Outcome(sequence, config, seed, metrics(ate), "it | broke" if ate is None else None)
        for seed, ate in enumerate(ates)
    ]


OUTCOMES = [
    *runs("fr3/w/xyz", "full", 0.012, 0.010, 0.0151),
    *runs("fr3/w/xyz", "base_line", 0.5, None, 0.3),
    *runs("my & [own]", "full", 0.2),
    *runs("my & [own]", "base_line", None),
]
"""Outcomes on one of the paper's sequences and on another sequence."""


PART = "part: 60 of 827 frames"
PARTS = [
    Outcome(run.sequence, run.config, run.seed, {**run.metrics, "difference": PART})
    for run in runs("fr3/w/xyz", "full", 0.001) + runs("fr3/w/xyz", "paper", 0.5)
]
"""Outcomes on a part of a sequence of the paper."""


def rows(text: str) -> list[list[str]]:
    """Cells of all table rows of a Markdown document."""
    return [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]


def test_table_shows_medians_ranges_failures_and_paper() -> None:
    heading, _, paper, own = rows(format_markdown(OUTCOMES))[:4]
    methods = list(load_paper_scores()["ate"]["fr3/w/xyz"])
    assert heading == ["sequence", "full", "base_line", *(f"{method} (paper)" for method in methods)]
    assert paper[:3] == ["fr3/w/xyz", "**0.0120 [0.0100-0.0151]**", "0.4000 [0.3000-0.5000], 1 failed"]
    scores = [load_paper_scores()["ate"]["fr3/w/xyz"][method].rmse for method in methods]
    assert paper[3:] == ["-" if score is None else f"{score:.4f}" for score in scores]
    assert own == ["my & [own]", "0.2000", "failed", *["-"] * len(methods)]  # a single method is not marked as the best


def test_all_three_metrics_have_tables() -> None:
    tables = make_error_tables(OUTCOMES)
    assert [table.heading for table in tables] == ["ATE, m", "RPE, m/s", "RPE, deg/s"]
    assert [table.rows["fr3/w/xyz"][0].text for table in tables[1:]] == [
        "0.0012 [0.0010-0.0015]",
        "1.2000 [1.0000-1.5100]",
    ]
    assert "V3D-SLAM (paper)" in tables[2].methods


@pytest.mark.parametrize(
    ("ours", "best"), [(0.0140, ["full"]), (0.01412, ["full", "CFP-SLAM (paper)"]), (0.5, ["CFP-SLAM (paper)"])]
)
def test_best_of_row_is_lowest_as_shown(ours: float, best: list[str]) -> None:
    (table, *_) = make_error_tables([*runs("fr3/w/xyz", "full", ours), *runs("fr3/w/xyz", "base", 0.6)])
    cells = dict(zip(table.methods, table.rows["fr3/w/xyz"], strict=True))
    assert [method for method, cell in cells.items() if cell.best] == best


def test_other_sequences_have_no_paper_columns() -> None:
    document = format_markdown([*runs("demo", "full", 0.1), *runs("demo", "paper", 0.2)])
    assert rows(document)[0] == ["sequence", "full", "paper"]
    assert rows(document)[2] == ["demo", "**0.1000**", "0.2000"]
    assert "(paper)" not in document


def test_missing_sequences_keep_the_papers_order_and_scores() -> None:
    outcomes = [*runs("fr3/w/static", "full", 0.006), *runs("fr3/s/xyz", "full", 0.009)]
    short = [short_name(name) for name in PAPER_SEQUENCES]
    absent = [name for name in short if name not in ("fr3/w/static", "fr3/s/xyz")]
    heading, _, *lines = rows(format_markdown(outcomes, absent).partition("\n## RPE")[0])
    table = {line[0]: dict(zip(heading, line, strict=True)) for line in lines}
    assert list(table) == short
    assert table["fr3/w/rpy"]["full"] == "not here" and table["fr3/w/rpy"]["DynaSLAM (paper)"] == "**0.0354**"
    assert table["fr3/w/static"]["full"] == "**0.0060**"
    assert format_latex(outcomes, absent).count("not here") == 3 * 6
    missing = [row for row in csv.DictReader(format_csv(outcomes, absent).splitlines()) if row["method"] == "full"]
    assert [row["median"] for row in missing[:8]] == ["0.009", *[""] * 5, "0.006", ""]


def test_names_with_marks_of_tables_and_html_are_escaped_in_markdown() -> None:
    document = format_markdown(runs("a|b & c&lt; <i>", "x|y", 0.1))
    assert r"| sequence | x\|y |" in document and r"| a\|b & c\&lt; \<i> | 0.1000 |" in document


def test_failures_are_listed_below() -> None:
    document = format_markdown(OUTCOMES)
    assert document.count("- fr3/w/xyz, base_line, seed 1: failed: it | broke") == 1
    assert "Failed" not in format_markdown(runs("demo", "full", 0.1))
    nothing = format_markdown(runs("demo", "full", None))
    assert "seed 0: failed" in nothing and not rows(nothing)


def test_outcomes_without_ground_truth_have_no_tables() -> None:
    outcomes = [Outcome("demo", "full", 0, {"ate": None, "rpe": None})]
    assert make_error_tables(outcomes) == [] and make_screen_tables(outcomes) == []
    assert "tabular" not in format_latex(outcomes)


def test_line_of_a_run_without_scores_has_the_reason() -> None:
    assert str(Outcome("s", "full", 0, {"ate": None})) == "s, full, seed 0: no ground truth, not scored"
    lost = Outcome("s", "full", 0, {"ate": None, "diagnosis": "s: the camera was not found in any of the 9 frames"})
    assert str(lost) == "s, full, seed 0: s: the camera was not found in any of the 9 frames"
    short = Outcome("s", "full", 0, {"ate": None, "notes": ["only 2 poses: at least 3 are needed for an ATE"]})
    assert str(short) == "s, full, seed 0: only 2 poses: at least 3 are needed for an ATE"


def test_latex_is_balanced_and_has_same_values() -> None:
    text = format_latex(OUTCOMES)
    for name in ("table*", "tabular"):
        assert text.count(f"\\begin{{{name}}}") == text.count(f"\\end{{{name}}}") == 3
    for rule in ("toprule", "midrule", "bottomrule"):
        assert text.count(f"\\{rule}") == 3
    assert text.startswith("% \\usepackage{booktabs}")
    columns = {len(match) for match in re.findall(r"\\begin\{tabular\}\{(l?r+)\}", text)}
    lines = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(lines) == 9
    assert {len(re.findall(r"(?<!\\)&", line)) + 1 for line in lines} == columns
    assert r"\textbf{0.0120 {[}0.0100--0.0151]}" in text
    assert r"base\_line" in text and r"my \& {[}own] & 0.2000 & failed & -- &" in text
    depth = 0
    for character in re.sub(r"\\[{}]", "", text):
        depth += (character == "{") - (character == "}")
        assert depth >= 0
    assert depth == 0


def test_long_latex_tables_break_across_pages() -> None:
    outcomes = [run for i in range(41) for run in runs(f"room_{i}", "full", 0.1)]
    short, long = format_latex(outcomes[:40]), format_latex(outcomes)
    assert "table*" in short and "longtable" not in short
    assert long.splitlines()[1].startswith("% \\usepackage{longtable}") and "table*" not in long
    assert long.count("\\begin{longtable}{lr}") == long.count("\\end{longtable}") == 3
    assert long.count("\\toprule") == long.count("\\midrule") == 6 and long.count("\\bottomrule") == 3
    assert long.count("room\\_") == 3 * 41 and long.count("Sequence & full") == 6


@pytest.mark.parametrize(("name", "is_latin"), [("fläche_ő", True), ("日本", False), ("u\u0308ber", False)])
def test_latex_names_the_program_for_other_scripts(name: str, is_latin: bool) -> None:
    text = format_latex(runs(name, "full", 0.1))
    assert ("% XeLaTeX or LuaLaTeX" in text.splitlines()[1]) != is_latin


def test_csv_has_unrounded_values() -> None:
    table = list(csv.DictReader(format_csv(OUTCOMES).splitlines()))
    ours = {(row["metric"], row["sequence"], row["method"]): row for row in table}
    assert len(ours) == len(table) == 3 * (2 * 2 + 8)
    row = ours["ate.rmse", "fr3/w/xyz", "full"]
    assert [float(row[name]) for name in ("median", "lowest", "highest")] == [0.012, 0.010, 0.0151]
    assert (row["seeds"], row["failed"], float(row["sd"])) == ("3", "0", 0.006)
    row = ours["rpe.rot.rmse", "fr3/w/xyz", "base_line"]
    assert [float(row[name]) for name in ("median", "lowest", "highest")] == [40, 30, 50]
    assert (row["seeds"], row["failed"]) == ("3", "1")
    assert ours["ate.rmse", "my & [own]", "base_line"]["median"] == ""
    paper = ours["ate.rmse", "fr3/w/xyz", "V3D-SLAM (paper)"]
    assert float(paper["median"]) == 0.0153 and float(paper["sd"]) == 0.0080 and paper["seeds"] == ""
    assert ours["ate.rmse", "fr3/w/xyz", "TRS (paper)"]["sd"] == ""  # the paper has a dash


def test_screen_table_fits_and_brackets_are_not_markup() -> None:
    console = Console(width=80, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    for table in make_screen_tables(OUTCOMES):
        console.print(table)
    text = console.export_text()
    for words in ("my & [own]", "[0.0100-0.0151]", "V3D-SLAM", "1 failed", "RPE, deg/s"):
        assert words in text
    assert "…" not in text and "DynaSLAM" not in text


def test_long_names_on_the_screen_lack_their_middle() -> None:
    console = Console(width=200, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    for table in make_screen_tables([*runs("x" * 99 + "y" * 101, "full", 0.1), *runs("s" * 40, "full", 0.1)])[:1]:
        console.print(table)
    text = console.export_text()
    assert f" {'x' * 20}…{'y' * 19} " in text and f" {'s' * 40} " in text
    assert max(map(len, text.splitlines())) < 60


@pytest.mark.parametrize(("factor", "colour"), [(0.5, "32"), (2.0, "35")])  # green, magenta
def test_screen_explains_brackets_and_colours_below_the_tables(factor: float, colour: str) -> None:
    outcomes = [*runs("demo", "full", 0.1, 0.2, 0.3), *runs("demo", "fast", *(factor * x for x in (0.1, 0.2, 0.3)))]
    file = StringIO()
    console = Console(width=80, soft_wrap=True, force_terminal=True, color_system="standard", file=file)
    for shown in make_screen_tables(outcomes):
        console.print(shown)
    written = file.getvalue()
    assert f"\x1b[1;{colour}m{factor:.3f}" in written
    errors, _, ratios = Text.from_ansi(written).plain.partition("relative to full")
    assert "median and [range] over the seeds" in errors
    assert "geometric mean and [95 % interval] over the seeds" in " ".join(ratios.split())
    assert "Green: errors are smaller; magenta: larger." in " ".join(ratios.split())
    assert max(map(len, ratios.splitlines())) <= 80


def test_part_of_a_sequence_is_marked_in_all_tables() -> None:
    outcomes = [*PARTS, *runs("fr3/s/xyz", "full", 0.02)]
    label = f"fr3/w/xyz ({PART})"
    markdown = rows(format_markdown(outcomes))
    assert [row[0] for row in markdown[2:4]] == [label, "fr3/s/xyz"]
    assert markdown[2][1] == "0.0010" and "**" not in "".join(markdown[2])  # no value is the best of a part
    assert label in format_latex(outcomes)
    records = list(csv.DictReader(format_csv(outcomes).splitlines()))
    assert {row["difference"] for row in records if (row["sequence"], row["method"]) == ("fr3/w/xyz", "full")} == {PART}
    assert {row["difference"] for row in records if row["sequence"] == "fr3/s/xyz"} == {""}
    console = Console(width=200, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    for table in make_screen_tables(outcomes):
        console.print(table)
    assert console.export_text().count(f"({PART})") == 3
    assert str(PARTS[0]) == f"fr3/w/xyz, full, seed 0: ATE 0.0010 m ({PART})"


def test_name_in_tables_is_one_line_without_control_characters() -> None:
    assert label_sequence("a\nb\x1b[31m", "part: 3 of 9 frames") == "a\\nb\\x1b[31m (part: 3 of 9 frames)"


def test_tables_read_each_outcome_a_fixed_number_of_times() -> None:
    """The tables are made after each run of a batch, which can have thousands."""
    reads = 0

    class CountedOutcome(Outcome):
        def __getattribute__(self, name: str) -> Any:
            nonlocal reads
            reads += 1
            return super().__getattribute__(name)

    def reads_per_outcome(sequences: int) -> float:
        nonlocal reads
        outcomes = [
            CountedOutcome(run.sequence, run.config, run.seed, run.metrics)
            for k in range(sequences)
            for config in ("full", "paper")
            for run in runs(f"room_{k}", config, 0.1, 0.2)
        ]
        reads = 0
        format_markdown(outcomes), format_latex(outcomes), format_csv(outcomes), make_screen_tables(outcomes)
        return reads / len(outcomes)

    assert reads_per_outcome(32) < 1.5 * reads_per_outcome(2)


def test_notes_and_missing_scores_are_listed() -> None:
    (scored,) = runs("room", "full", 0.1)
    noted = replace(scored, metrics={**scored.metrics, "notes": ["aligned by the orientations"]})
    unscored = Outcome("attic", "full", 0, {"diagnosis": "attic: the depth images are empty"})
    document = format_markdown([noted, unscored])
    assert "## Notes\n\n- room, full, seed 0: aligned by the orientations\n" in document
    assert "## Not scored\n\n- attic, full, seed 0: attic: the depth images are empty\n" in document


def test_other_sequences_stay_in_tables_with_absent_ones() -> None:
    outcomes = [*runs("my_room", "full", 0.1), *runs("fr3/w/xyz", "full", 0.02)]
    lines = rows(format_markdown(outcomes, ["fr3/w/rpy"]).partition("\n## RPE")[0])
    assert [line[0] for line in lines[2:]] == ["fr3/w/xyz", "fr3/w/rpy", "my_room"]
