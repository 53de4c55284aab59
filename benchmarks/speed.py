"""How fast the whole system is, beside other systems on the same frames, as Markdown.

``python benchmarks/speed.py --seqs fr1_rpy crowd_rpy --runs 5`` lets all contenders take turns, in random order, each
in a process of its own. What the times hold is said above the tables (`ABOUT`).
"""

from __future__ import annotations

import argparse
import os
import random
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from command import command_line, publish, takes_vocabulary
from contenders import OURS, PEERS
from contenders.process import ContenderError, Measured, measure
from heading import heading
from sequences import located, trained_vocabulary

from v3d_torch.datasets import load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.evaluation.tables import row, spread

REFERENCE = "pyorbslam3"
CONTENDERS = (*OURS, *PEERS)
ABOUT = (
    "Each run is a process of its own. Times are from before the first frame is read until the last has a pose: reading"
    " and decoding of the images are in them; imports, loading of network or vocabulary, begin of the second process,"
    " what ORB-SLAM3's threads still map after the last frame, and writing of results are not."
    " CPU time is that of all threads, and of a second process, user and system. Ratios are to pyorbslam3's run of the"
    " same turn: above 1, more frames a second, or more CPU time. Values are the median [lowest-highest] of the turns."
)

Turn = dict[str, Measured | str]
"""Of each contender what it measured, or the sentence it failed with."""


def take_turn(sequence: str, options: argparse.Namespace, vocabulary: Path, order: random.Random) -> Turn:
    """Run every contender once, in an order that differs from turn to turn."""
    turn: Turn = {}
    for name in order.sample(CONTENDERS, len(CONTENDERS)):
        load = os.getloadavg()[0]
        try:
            source = located(sequence, options.data_root)
            turn[name] = found = measure(name, source, options.data_root, frames=options.frames, vocabulary=vocabulary)
            result = f"{rate(found):.1f} frames a second, {cpu(found):.1f} ms of CPU time a frame"
        except ContenderError as error:
            turn[name] = str(error)
            result = f"failed: {error}"
        print(f"{sequence}, {name}: {result} (load before it {load:.1f})", file=sys.stderr)
    return turn


def rate(run: Measured) -> float:
    """Frames a second."""
    return run.frames / run.seconds


def cpu(run: Measured) -> float:
    """Milliseconds of CPU time a frame."""
    return 1e3 * run.cpu_seconds / run.frames


def speed_table(turns: Sequence[Turn]) -> Iterator[str]:
    """A row per contender."""
    yield row(["contender", "frames a second", "ratio", "CPU ms a frame", "ratio", "frames with a pose", "runs failed"])
    yield row(["---"] + ["---:"] * 6)
    for name in CONTENDERS:
        runs = [run for turn in turns if isinstance(run := turn[name], Measured)]
        pairs = [
            (run, reference)
            for turn in turns
            if isinstance(run := turn[name], Measured) and isinstance(reference := turn[REFERENCE], Measured)
        ]
        yield row(
            [
                name,
                spread([rate(run) for run in runs], ".1f"),
                spread([rate(run) / rate(reference) for run, reference in pairs], ".2f"),
                spread([cpu(run) for run in runs], ".1f"),
                spread([cpu(run) / cpu(reference) for run, reference in pairs], ".2f"),
                spread([poses(run) / run.frames for run in runs], ".0%"),
                f"{len(turns) - len(runs)} of {len(turns)}",
            ]
        )


def poses(run: Measured) -> int:
    """How many frames it found a pose for."""
    return 0 if run.trajectory is None else len(run.trajectory)


def stage_table(turns: Sequence[Turn]) -> Iterator[str]:
    """Milliseconds a frame of each of our stages."""
    yield row(["stage, ms a frame", *OURS])
    yield row(["---"] + ["---:"] * len(OURS))
    runs = [[run for turn in turns if isinstance(run := turn[name], Measured)] for name in OURS]
    for stage in dict.fromkeys(stage for column in runs for run in column for stage in run.stages):
        times = [[1e3 * run.stages[stage] / run.frames for run in column if stage in run.stages] for column in runs]
        yield row([stage, *(spread(values, ".1f") for values in times)])


def failures(turns: Sequence[Turn]) -> Iterator[str]:
    """Each failed run with its sentence."""
    for number, turn in enumerate(turns, start=1):
        yield from (f"- turn {number}, {name}: {run}" for name, run in turn.items() if isinstance(run, str))


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_line("Speed of the whole system beside others', as Markdown.")
    parser.add_argument("--seqs", nargs="+", required=True, help="names of sequences")
    parser.add_argument("--runs", type=int, default=5, help="turns of all contenders on each sequence [5]")
    parser.add_argument("--frames", type=int, help="frames of each sequence, from the first [all]")
    takes_vocabulary(parser)
    return parser


def main() -> None:
    """Let all take their turns, and print the tables."""
    parser = arguments()
    options = parser.parse_args()
    if options.runs < 1 or (options.frames is not None and options.frames < 2):
        parser.error("give at least --runs 1 and --frames 2")
    lines = [*heading(PEERS), "", ABOUT]
    try:
        for name in options.seqs:  # better now than as a failure of every contender
            load_sequence(located(name, options.data_root), data_root=options.data_root)
        vocabulary = options.vocabulary or trained_vocabulary(options.seqs, options.data_root)
    except V3DError as error:
        parser.error(str(error))
    order = random.Random(0)  # noqa: S311 (no secret)
    for sequence in dict.fromkeys(options.seqs):
        turns = [take_turn(sequence, options, vocabulary, order) for _ in range(options.runs)]
        lines += ["", f"## {sequence}", "", *speed_table(turns), "", *stage_table(turns), "", *failures(turns)]
    publish(lines, options, parser)


if __name__ == "__main__":
    main()
