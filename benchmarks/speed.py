"""Speed of the whole system beside other systems on the same frames, as Markdown.

``python benchmarks/speed.py --seqs fr1_rpy crowd_rpy --runs 5`` runs all systems in turn, in random order, each in
its own process, and pyorbslam3 before and after each other one. `ABOUT` defines the times.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import mean

from command import add_vocabulary_option, make_parser, publish
from heading import make_heading
from sequences import locate_sequence, trained_vocabulary
from storage import Measurement, Row, file_of
from systems import OURS, PEERS
from systems.process import Measured, SystemRunError, measure

from v3d_torch.datasets import load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.evaluation.tables import format_median_and_range, markdown_row

REFERENCE = "pyorbslam3"
SYSTEMS = (*OURS, *PEERS)
ABOUT = (
    "Each run is a process of its own. Times run from before the first frame is read until the last frame has a pose."
    " They include reading and decoding of the images. They exclude imports, loading of the network or vocabulary,"
    " mapping by ORB-SLAM3's threads and fusion of our dense map after the last frame, and writing of results. CPU time"
    " is user and system time of all threads. Ratios compare with the mean of the two runs of pyorbslam3 just before"
    " and after, because the speed of a shared machine changes within minutes: above 1 means more frames per second, or"
    " more CPU time. Values are the median [lowest-highest] of the runs."
)

Turn = list[tuple[str, Measured | str]]
"""Systems in the order of their runs, each with its measurement or error message: `REFERENCE`, another system,
`REFERENCE`, the next system, and so on."""


def take_turn(sequence: str, options: argparse.Namespace, vocabulary: Path, order: random.Random) -> Turn:
    """Run every system once, in random order, with runs of the reference before and after it."""
    others = [name for name in SYSTEMS if name != REFERENCE]
    names = [REFERENCE]
    for name in order.sample(others, len(others)):
        names += [name, REFERENCE]
    return [(name, run_system(name, sequence, options, vocabulary)) for name in names]


def run_system(name: str, sequence: str, options: argparse.Namespace, vocabulary: Path) -> Measured | str:
    """Run a system, and log its speed; returns the error message of a failed run."""
    load, source = os.getloadavg()[0], locate_sequence(sequence, options.data_root)
    run: Measured | str
    try:
        run = measure(name, source, options.data_root, frames=options.frames, vocabulary=vocabulary)
        result = f"{rate(run):.1f} frames per second, {cpu(run):.1f} CPU ms per frame"
    except SystemRunError as error:
        run = str(error)
        result = f"failed: {error}"
    print(f"{sequence}, {name}: {result} (load before it {load:.1f})", file=sys.stderr)
    return run


def rate(run: Measured) -> float:
    """Return frames per second."""
    return run.frames / run.seconds


def cpu(run: Measured) -> float:
    """Return CPU time per frame, milliseconds."""
    return 1e3 * run.cpu_seconds / run.frames


def runs_of(turns: Sequence[Turn], name: str) -> list[Measured]:
    """Return the runs of a system that did not fail."""
    return [run for turn in turns for each, run in turn if each == name and isinstance(run, Measured)]


def ratios(turns: Sequence[Turn], name: str, quantity: Callable[[Measured], float]) -> list[float]:
    """Return a quantity of each run of a system, divided by its mean in the runs of the reference around it."""
    if name == REFERENCE:
        return [1.0] * len(runs_of(turns, name))
    return [
        quantity(run) / mean(map(quantity, around))
        for turn in turns
        for before, (each, run), after in zip(turn, turn[1:], turn[2:], strict=False)
        if each == name and isinstance(run, Measured) and (around := runs_of([[before, after]], REFERENCE))
    ]


def system_rows(turns: Sequence[Turn]) -> Iterator[Row]:
    """Yield a row per system."""
    for name in SYSTEMS:
        runs = runs_of(turns, name)
        attempts = sum(each == name for turn in turns for each, _ in turn)
        yield {
            "system": name,
            "frames": str(runs[0].frames) if runs else "-",
            "fps": format_median_and_range([rate(run) for run in runs], ".1f"),
            "fps_ratio": format_median_and_range(ratios(turns, name, rate), ".2f"),
            "cpu_ms": format_median_and_range([cpu(run) for run in runs], ".1f"),
            "cpu_ratio": format_median_and_range(ratios(turns, name, cpu), ".2f"),
            "coverage": format_median_and_range([poses(run) / run.frames for run in runs], ".0%"),
            "failed": f"{attempts - len(runs)} of {attempts}",
        }


def speed_table(turns: Sequence[Turn]) -> Iterator[str]:
    """Yield a line per system."""
    columns = ["system", "frames per second", "ratio", "CPU ms per frame", "ratio", "coverage", "runs failed"]
    yield markdown_row(columns)
    yield markdown_row(["---"] + ["---:"] * (len(columns) - 1))
    shown = ("system", "fps", "fps_ratio", "cpu_ms", "cpu_ratio", "coverage", "failed")
    yield from (markdown_row([cells[name] for name in shown]) for cells in system_rows(turns))


def poses(run: Measured) -> int:
    """Return the number of frames with a pose."""
    return 0 if run.trajectory is None else len(run.trajectory)


def stage_times(turns: Sequence[Turn]) -> Iterator[Row]:
    """Yield a row per system of ours and stage: milliseconds per frame."""
    for name in OURS:
        runs = runs_of(turns, name)
        for stage in dict.fromkeys(stage for run in runs for stage in run.stages):
            times = [1e3 * run.stages[stage] / run.frames for run in runs if stage in run.stages]
            yield {"system": name, "stage": stage, "ms": format_median_and_range(times, ".1f")}


def stage_table(turns: Sequence[Turn]) -> Iterator[str]:
    """Yield a line per stage: milliseconds per frame of each of our systems."""
    yield markdown_row(["stage, ms per frame", *OURS])
    yield markdown_row(["---"] + ["---:"] * len(OURS))
    times = {(cells["system"], cells["stage"]): cells["ms"] for cells in stage_times(turns)}
    for stage in dict.fromkeys(stage for _, stage in times):
        yield markdown_row([stage, *(times.get((name, stage), "-") for name in OURS)])


def failures(turns: Sequence[Turn]) -> Iterator[str]:
    """Yield a line per failed run with its error message."""
    for number, turn in enumerate(turns, start=1):
        yield from (f"- turn {number}, {name}: {run}" for name, run in turn if isinstance(run, str))


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = make_parser("Speed of the whole system beside other systems, as Markdown.")
    parser.add_argument("--seqs", nargs="+", required=True, help="names of sequences")
    parser.add_argument("--runs", type=int, default=5, help="number of turns of all systems on each sequence [5]")
    parser.add_argument("--frames", type=int, help="number of frames of each sequence, from the first [all]")
    add_vocabulary_option(parser)
    return parser


def main() -> None:
    """Run all systems and print the tables."""
    parser = arguments()
    options = parser.parse_args()
    if options.runs < 1 or (options.frames is not None and options.frames < 2):
        parser.error("give at least --runs 1 and --frames 2")
    heading = make_heading(PEERS)
    lines = [*heading.lines(), "", ABOUT]
    try:
        for name in options.seqs:  # a missing sequence is one error, not a failure of every system
            load_sequence(locate_sequence(name, options.data_root), data_root=options.data_root)
        vocabulary = options.vocabulary or trained_vocabulary(options.seqs, options.data_root)
    except V3DError as error:
        parser.error(str(error))
    order = random.Random(0)  # noqa: S311 (not for cryptography)
    speed_rows: list[Row] = []
    stage_rows: list[Row] = []
    for sequence in dict.fromkeys(options.seqs):
        turns = [take_turn(sequence, options, vocabulary, order) for _ in range(options.runs)]
        lines += ["", f"## {sequence}", "", *speed_table(turns), "", *stage_table(turns), "", *failures(turns)]
        cells = {"sequence": Path(sequence).name}
        speed_rows += [cells | measured for measured in system_rows(turns)]
        stage_rows += [cells | measured for measured in stage_times(turns) if measured["system"] == OURS[0]]
    rows = {"speed": speed_rows, "stages": stage_rows}
    publish(lines, options, parser, {file_of(name): Measurement(heading, each) for name, each in rows.items()})


if __name__ == "__main__":
    main()
