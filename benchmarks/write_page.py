"""Write ``docs/benchmarks.md`` and the tables of ``README.md`` from the measurements in ``benchmarks/results``.

``python benchmarks/write_page.py`` has no options. Benchmarks store their measurements with ``--save``. A section whose
measurements are missing is left out.
"""

from __future__ import annotations

from pathlib import Path

from descriptions import peer_names, peer_speeds, sequence_list
from sections import SECTIONS, section_lines
from storage import RESULTS, load
from tables import accuracy_table, commits, speed_table

from v3d_torch.io.files import write_text

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
README = ROOT / "README.md"

BEGIN, END = "<!-- benchmarks:main -->", "<!-- /benchmarks:main -->"
"""Marks around the tables of the README."""

INTRODUCTION = """# Benchmarks

This page is written by `python benchmarks/write_page.py` from the measurements in `benchmarks/results`; do not edit it.
Each section names the command, commit, date and hardware of its measurements; `benchmarks/README.md` describes the
commands. A value with a range is the median [lowest-highest] of several runs.

**Sequences.** "Real" sequences are recordings. "Composed" sequences are put together from recordings of people and of
rooms. `demo` is the simulated sequence of the package."""


def page(folder: Path = RESULTS) -> str:
    """Return the page of all benchmarks."""
    results = {path.stem: load(path.stem, folder) for path in sorted(folder.glob("*.json"))}
    lines = [*INTRODUCTION.splitlines(), "", *sequence_list()]
    for title in SECTIONS:
        lines += section_lines(title, results)
    return "\n".join(lines) + "\n"


def main_tables(folder: Path = RESULTS) -> str:
    """Return the tables of the README: accuracy and speed."""
    accuracy, speed = load("accuracy", folder), load("speed", folder)
    lines = [
        "**Accuracy**: ATE RMSE in metres, median [lowest-highest] of 3 runs, the lowest in bold. `full` is the default"
        " configuration, `realtime` is `--config realtime`, `baseline` is `--segmenter none`. Composed sequences are"
        " real images of people in real rooms. ORB-SLAM3 (PyPI) is pyorbslam3; ORB-SLAM2, ORB-SLAM3 and NGD-SLAM, which"
        " masks people, were built from source. Parameters of v3d_torch were chosen on these sequences; the other"
        " systems have their default parameters, and vocabularies trained on these sequences (pyorbslam3) or on"
        " photographs. The true poses of walkers_room and walkers_crowd are accurate to about 0.03 m: smaller"
        " differences mean little there.",
        "",
        *accuracy_table(accuracy),
        "",
        "**Speed** on whole sequences at 640x480 on two cores, including reading of the images. ORB-SLAM3 is"
        f" pyorbslam3. Built from source, on another idle machine with two cores, {peer_names()}"
        f" process {peer_speeds('fps')} frames per second.",
        "",
        *speed_table(speed),
        "",
        f"Measured at the commits {', '.join(commits([*accuracy, *speed]))}; commands, dates, hardware and all other"
        " measurements are in [Benchmarks](docs/benchmarks.md).",
    ]
    return "\n".join(lines)


def insert_tables(readme: str, tables: str) -> str:
    """Replace the text between the marks in a README.

    Raises:
        ValueError: If a mark is missing.
    """
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"README.md: {BEGIN} or {END} is missing; add both marks around the tables")
    return f"{before}{BEGIN}\n{tables}\n{END}{after}"


def main() -> None:
    """Write the page and the tables of the README."""
    write_text(PAGE, page())
    write_text(README, insert_tables(README.read_text(encoding="utf-8"), main_tables()))


if __name__ == "__main__":
    main()
