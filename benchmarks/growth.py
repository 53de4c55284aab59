"""Time and memory of long runs and large maps, as Markdown.

``python benchmarks/growth.py --seq fr1_rpy --frames 5000`` plays a sequence again and again. After its last frame the
camera is back at the start, where it has to find itself in the map. A sequence is not played backwards, because a
rolling shutter would then scan against the direction that the map was made with. Before and after each tenth of the
run, a new system processes the beginning of the sequence in another process: its time shows whether the machine has
become slower. A second table has place recognition and pose graph alone, on thousands of synthetic keyframes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path
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
from systems.process import SystemRunError, measure
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
from v3d_torch.slam import V3DSLAM

BLOCKS = 10
"""Number of equal parts of a run, with one row each."""

REFERENCE_FRAMES = 300
"""Number of frames of the runs of new systems."""

FRACTIONS = (0.1, 0.25, 0.5, 1.0)
"""Fractions of the largest number of keyframes at which place recognition and pose graph are timed."""

QUERIES = 10
"""Number of timings, of which the median is reported."""


@dataclass(frozen=True)
class Block:
    """Measurements of a block of frames.

    Attributes:
        first: Number of its first frame, from 0.
        end: Number of the frame after its last one.
        wall_ms: Wall time per frame, milliseconds.
        slowest_ms: Largest wall time of a frame, milliseconds.
        cpu_ms: CPU time of all threads per frame, milliseconds.
        reference_ms: CPU time per frame of new systems, mean of one before and one after the block, milliseconds.
        resident_mb: Memory of the process after the block, megabytes.
        keyframes: Number of keyframes after the block.
        loops: Number of loops after the block.
    """

    first: int
    end: int
    wall_ms: float
    slowest_ms: float
    cpu_ms: float
    reference_ms: float
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


class BlockRecorder:
    """Measures a run in blocks of frames. Call it after each frame.

    Args:
        slam: System that processes the frames.
        frames: Number of frames, at least one for each block.
        reference: Measures the CPU time of a frame of a new system, milliseconds. The run waits for it.

    Attributes:
        blocks: Measurements of the blocks so far.
    """

    def __init__(self, slam: V3DSLAM, frames: int, reference: Callable[[], float]) -> None:
        self.blocks: list[Block] = []
        self._slam = slam
        self._ends = [frames * (block + 1) // BLOCKS for block in range(BLOCKS)]
        self._reference = reference
        self._reference_ms = reference()
        self._start()

    def __call__(self, *_: object) -> None:
        """Measure the frame that was processed last, and the block that ends with it."""
        now = time.perf_counter()
        self._slowest, self._last = max(self._slowest, now - self._last), now
        if len(self._slam.poses) == self._ends[len(self.blocks)]:
            self._end_block()
            self._start()

    def _start(self) -> None:
        self._wall = self._last = time.perf_counter()
        self._cpu, self._slowest = time.process_time(), 0.0

    def _end_block(self) -> None:
        first, end = self.blocks[-1].end if self.blocks else 0, len(self._slam.poses)
        wall, cpu = self._last - self._wall, time.process_time() - self._cpu
        before, self._reference_ms = self._reference_ms, self._reference()
        block = Block(
            first=first,
            end=end,
            wall_ms=1e3 * wall / (end - first),
            slowest_ms=1e3 * self._slowest,
            cpu_ms=1e3 * cpu / (end - first),
            reference_ms=(before + self._reference_ms) / 2,
            resident_mb=resident_mb(),
            keyframes=len(self._slam.map.active_keyframes),
            loops=self._slam.loop_closer.loop_count,
        )
        self.blocks.append(block)


def measure_long_run(sequence: RGBDSequence, frames: int, reference: Callable[[], float]) -> LongRun:
    """Play a sequence again and again, and measure every block of frames.

    Args:
        sequence: Sequence to play.
        frames: Number of frames.
        reference: See `BlockRecorder`.
    """
    system = Ours(Replay(sequence, again_and_again(len(sequence), frames)), "v3d_torch", seed=0)
    recorder = BlockRecorder(system.slam, frames, reference)
    system(recorder)
    blocks, times = recorder.blocks, system.pipeline.record.times
    headings = ["frames", "ms per frame", "slowest", "CPU ms per frame", "CPU ms of a new system"]
    headings += ["resident MB", "keyframes", "loops"]
    lines = [
        markdown_row([*headings, *(f"{stage} ms" for stage in times.stages)]),
        markdown_row(["---:"] * (len(headings) + len(times.stages))),
    ]
    for block in blocks:
        cells = [
            f"{block.first + 1}-{block.end}",
            f"{block.wall_ms:.1f}",
            f"{block.slowest_ms:.0f}",
            f"{block.cpu_ms:.1f}",
            f"{block.reference_ms:.1f}",
            f"{block.resident_mb:.0f}",
            str(block.keyframes),
            str(block.loops),
            *(f"{1e3 * seconds:.1f}" for seconds in times.wall[block.first : block.end].mean(dim=0).tolist()),
        ]
        lines.append(markdown_row(cells))
    early, late = blocks[0], blocks[-1]
    summary = {
        "sequence": table_name(sequence),
        "frames": str(frames),
        "cpu_ms": ", ".join(f"{block.cpu_ms:.1f}" for block in blocks),
        "cpu_ratio": ", ".join(f"{block.cpu_ms / block.reference_ms:.2f}" for block in blocks),
        "memory_mb": f"{early.resident_mb:.0f} to {late.resident_mb:.0f}",
        "memory_kb_per_frame": f"{1e3 * (late.resident_mb - early.resident_mb) / (frames - early.end):.0f}",
        "keyframes": f"{min(block.keyframes for block in blocks)} to {max(block.keyframes for block in blocks)}",
        "loops": str(late.loops),
    }
    return LongRun(lines, summary)


def resident_mb() -> float:
    """Return the memory of this process, megabytes."""
    return psutil.Process().memory_info().rss / 1e6


def measure_new_system(source: str, data_root: Path) -> float:
    """Return the CPU time per frame of a new system at the beginning of a sequence, milliseconds."""
    measured = measure("v3d_torch", source, data_root, frames=REFERENCE_FRAMES)
    return 1e3 * measured.cpu_seconds / measured.frames


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
        source = locate_sequence(options.seq, options.data_root)
        sequence = load_sequence(source, data_root=options.data_root)
        run = measure_long_run(sequence, options.frames, partial(measure_new_system, source, options.data_root))
    except (V3DError, SystemRunError) as error:
        parser.error(str(error))
    rows = list(measure_keyframes(options.keyframes))
    lines = [*heading.lines(), "", f"## {options.seq}, again and again", "", *run.lines]
    lines += ["", "## Synthetic keyframes", "", *flat(rows, columns.KEYFRAMES | {"iterations": "iterations"})]
    measurements = {"growth": Measurement(heading, [run.row]), "keyframes": Measurement(heading, rows)}
    publish(lines, options, parser, measurements)


if __name__ == "__main__":
    main()
