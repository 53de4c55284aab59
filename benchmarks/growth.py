"""Time and memory of long runs and large maps, as Markdown.

``python benchmarks/growth.py --seq fr1_rpy --frames 5000`` plays a sequence again and again. After its last frame the
camera is back at the start, where it has to find itself in the map. A sequence is not played backwards, because a
rolling shutter would then scan against the direction that the map was made with. A second table has place recognition
and pose graph alone, on thousands of synthetic keyframes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial, reduce
from statistics import median

import columns
import psutil
import torch
from command import make_parser, publish
from heading import make_heading
from replay import Replay, again_and_again
from sequences import locate_sequence, table_name
from storage import Measurement, Row
from systems.ours import Ours
from tables import flat
from timing import timed
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase
from v3d_torch.backend.pose_graph import optimise_pose_graph
from v3d_torch.config import Config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.evaluation.tables import markdown_row
from v3d_torch.geometry.se3 import invert, se3_exp

BLOCKS = 10
"""Number of equal parts of a run, with one row each."""

FRACTIONS = (0.1, 0.25, 0.5, 1.0)
"""Fractions of the largest number of keyframes at which place recognition and pose graph are timed."""

QUERIES = 10
"""Number of timings, of which the median is reported."""


@dataclass(frozen=True)
class Snapshot:
    """State after a frame: wall and CPU time in seconds, memory, size of the map."""

    wall: float
    cpu: float
    resident_mb: float
    keyframes: int
    loops: int


@dataclass(frozen=True)
class LongRun:
    """A long run.

    Attributes:
        lines: Table with a row per block of frames: time per frame, and memory and map at the end of the block.
        row: Summary of the run, for `storage`.
    """

    lines: list[str]
    row: Row


def measure_long_run(sequence: RGBDSequence, frames: int) -> LongRun:
    """Play a sequence again and again, and measure every block of frames."""
    system = Ours(Replay(sequence, again_and_again(len(sequence), frames)), "v3d_torch", seed=0)
    slam = system.slam

    def take_snapshot() -> Snapshot:
        keyframes = len(slam.map.active_keyframes)
        return Snapshot(time.perf_counter(), time.process_time(), resident_mb(), keyframes, slam.loop_closer.loop_count)

    snapshots = [take_snapshot()]
    system(lambda *_: snapshots.append(take_snapshot()))
    times = system.pipeline.record.times
    columns = ["frames", "ms per frame", "slowest", "CPU ms per frame", "resident MB", "keyframes", "loops"]
    lines = [
        markdown_row([*columns, *(f"{stage} ms" for stage in times.stages)]),
        markdown_row(["---:"] * (len(columns) + len(times.stages))),
    ]
    cpu_ms: list[str] = []
    ends: list[Snapshot] = []
    for block in range(BLOCKS):
        first, end = frames * block // BLOCKS, frames * (block + 1) // BLOCKS
        if first == end:
            continue
        start, stop = snapshots[first], snapshots[end]
        slowest = max(snapshots[i + 1].wall - snapshots[i].wall for i in range(first, end))
        cpu_ms.append(f"{1e3 * (stop.cpu - start.cpu) / (end - first):.1f}")
        ends.append(stop)
        cells = [
            f"{first + 1}-{end}",
            f"{1e3 * (stop.wall - start.wall) / (end - first):.1f}",
            f"{1e3 * slowest:.0f}",
            cpu_ms[-1],
            f"{stop.resident_mb:.0f}",
            str(stop.keyframes),
            str(stop.loops),
            *(f"{1e3 * seconds:.1f}" for seconds in times.wall[first:end].mean(dim=0).tolist()),
        ]
        lines.append(markdown_row(cells))
    early, late = ends[0], ends[-1]
    later = frames - frames // BLOCKS
    summary = {
        "sequence": table_name(sequence),
        "frames": str(frames),
        "cpu_ms": ", ".join(cpu_ms),
        "memory_mb": f"{early.resident_mb:.0f} to {late.resident_mb:.0f}",
        "memory_kb_per_frame": f"{1e3 * (late.resident_mb - early.resident_mb) / later:.0f}",
        "keyframes": f"{min(end.keyframes for end in ends)} to {max(end.keyframes for end in ends)}",
        "loops": str(late.loops),
    }
    return LongRun(lines, summary)


def resident_mb() -> float:
    """Return the memory of this process, megabytes."""
    return psutil.Process().memory_info().rss / 1e6


def measure_keyframes(max_count: int) -> Iterator[Row]:
    """Yield a row per number of keyframes: times to add one, to query the database, and to close a loop over all."""
    generator = torch.Generator().manual_seed(0)
    close_ring(QUERIES, generator)  # warm up
    database, candidates = KeyframeDatabase(), Config().loop.candidates
    adding: list[float] = []
    for count in sorted({max(round(fraction * max_count), QUERIES) for fraction in FRACTIONS}):
        while len(database) < count:
            descriptors = random_descriptors(generator)
            adding.append(timed(partial(database.add, len(database), descriptors))[0])
        queries = (partial(database.query, flip_bits(descriptors, generator), candidates) for _ in range(QUERIES))
        querying = [timed(query)[0] for query in queries]
        add_ms, query_ms = (f"{1e3 * median(seconds[-QUERIES:]):.1f}" for seconds in (adding, querying))
        yield {"keyframes": str(count), "add_ms": add_ms, "query_ms": query_ms, **close_ring(count, generator)}


def random_descriptors(generator: torch.Generator) -> Tensor:
    """Return random descriptors of a keyframe, uint8, shape (N, 32); they differ more than those of images."""
    return torch.randint(256, (Config().features.count, 32), generator=generator, dtype=torch.uint8)


def flip_bits(descriptors: Tensor, generator: torch.Generator) -> Tensor:
    """Return descriptors with one bit in 16 flipped, as if the features were observed again."""
    flips = [torch.randint(256, descriptors.shape, generator=generator, dtype=torch.uint8) for _ in range(4)]
    return descriptors ^ reduce(torch.bitwise_and, flips)


def close_ring(count: int, generator: torch.Generator) -> Row:
    """Close a loop over drifting cameras on a circle of radius 5 m, each connected to the next three.

    Returns:
        Cells: time of the pose graph, number of iterations, mean position error before and after.
    """
    turn = torch.zeros(6, dtype=torch.float64)
    turn[0] = 2 * torch.pi * 5 / count  # along the circle
    turn[4] = 2 * torch.pi / count  # about the vertical axis
    step = se3_exp(turn)
    noise = se3_exp(1e-3 * torch.randn(count, 6, generator=generator, dtype=torch.float64))
    true, drifted = [torch.eye(4, dtype=torch.float64)], [torch.eye(4, dtype=torch.float64)]
    for error in noise[1:]:
        true.append(true[-1] @ step)
        drifted.append(drifted[-1] @ step @ error)
    T_wc, T_true = torch.stack(drifted), torch.stack(true)
    edges = torch.cat([torch.stack([torch.arange(count - k), torch.arange(k, count)], dim=1) for k in (1, 2, 3)])
    measured = invert(T_wc[edges[:, 0]]) @ T_wc[edges[:, 1]]
    loop = (invert(T_true[0]) @ T_true[-1])[None]
    closed = torch.cat([edges, torch.tensor([[0, count - 1]])]), torch.cat([measured, loop])
    seconds, solution = timed(partial(optimise_pose_graph, T_wc, *closed))
    before, after = ((T - T_true)[:, :3, 3].norm(dim=1).mean() for T in (T_wc, solution.T_wc))
    return {
        "pose_graph_s": f"{seconds:.2f}",
        "iterations": str(int(solution.iterations)),
        "error_before": f"{before:.3f}",
        "error_after": f"{after:.3f}",
    }


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = make_parser("Time and memory of a long run and of many keyframes, as Markdown.")
    parser.add_argument("--seq", default="demo", help="sequence to play again and again [demo]")
    parser.add_argument("--frames", type=int, default=5000, help="number of frames of the run [5000]")
    parser.add_argument("--keyframes", type=int, default=5000, help="largest number of synthetic keyframes [5000]")
    return parser


def main() -> None:
    """Run both measurements and print their tables."""
    parser = arguments()
    options = parser.parse_args()
    if options.frames < BLOCKS or options.keyframes < QUERIES:
        parser.error(f"give at least --frames {BLOCKS} and --keyframes {QUERIES}")
    heading = make_heading()
    try:
        sequence = load_sequence(locate_sequence(options.seq, options.data_root), data_root=options.data_root)
        run = measure_long_run(sequence, options.frames)
    except V3DError as error:
        parser.error(str(error))
    rows = list(measure_keyframes(options.keyframes))
    lines = [*heading.lines(), "", f"## {options.seq}, again and again", "", *run.lines]
    lines += ["", "## Synthetic keyframes", "", *flat(rows, columns.KEYFRAMES | {"iterations": "iterations"})]
    measurements = {"growth": Measurement(heading, [run.row]), "keyframes": Measurement(heading, rows)}
    publish(lines, options, parser, measurements)


if __name__ == "__main__":
    main()
