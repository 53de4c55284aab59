"""What a long run costs: time and memory as frames and keyframes grow in number, as Markdown.

``python benchmarks/growth.py --seq fr1_rpy --frames 5000`` plays a sequence forth and back. Below: place recognition
and pose graph alone, on keyframes that are made up, since no sequence at hand has thousands.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial, reduce
from statistics import fmean, median
from typing import TypeVar

import psutil
import torch
from command import command_line, publish
from contenders.ours import Ours
from heading import heading
from replay import Replay, forth_and_back
from sequences import located
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase
from v3d_torch.backend.pose_graph import optimise_pose_graph
from v3d_torch.config import Config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.evaluation.tables import row
from v3d_torch.geometry.se3 import invert, se3_exp

BLOCKS = 10
SHARES = (0.1, 0.25, 0.5, 1.0)
"""Of the most keyframes, at which places and pose graph are timed."""
LOOKS = 10
"""Timings of which the median counts."""

Made = TypeVar("Made")


@dataclass(frozen=True)
class Mark:
    """How things stand after a frame."""

    clock: float
    cpu: float
    resident_mb: float
    keyframes: int
    loops: int


def long_run(sequence: RGBDSequence, frames: int) -> Iterator[str]:
    """A row per block of frames: what a frame takes, and what there is at the end of the block."""
    system = Ours(Replay(sequence, forth_and_back(len(sequence), frames)), "v3d_torch", seed=0)
    slam = system.slam

    def mark() -> Mark:
        keyframes = len(slam.mapper.map.active_keyframes)
        return Mark(time.perf_counter(), time.process_time(), resident_mb(), keyframes, slam.loop_closer.loop_count)

    marks = [mark()]
    system(lambda *_: marks.append(mark()))
    stages = list(slam.timer.seconds)
    columns = ["frames", "ms a frame", "slowest", "CPU ms a frame", "resident MB", "keyframes", "loops"]
    yield row([*columns, *(f"{stage} ms" for stage in stages)])
    yield row(["---:"] * (len(columns) + len(stages)))
    for block in range(BLOCKS):
        first, end = frames * block // BLOCKS, frames * (block + 1) // BLOCKS
        if first == end:
            continue
        then, now = marks[first], marks[end]
        slowest = max(marks[i + 1].clock - marks[i].clock for i in range(first, end))
        rows = system.pipeline.record.frames[first:end]
        yield row(
            [
                f"{first + 1}-{end}",
                f"{1e3 * (now.clock - then.clock) / (end - first):.1f}",
                f"{1e3 * slowest:.0f}",
                f"{1e3 * (now.cpu - then.cpu) / (end - first):.1f}",
                f"{now.resident_mb:.0f}",
                str(now.keyframes),
                str(now.loops),
                *(f"{1e3 * fmean(frame.get(stage, 0.0) for frame in rows):.1f}" for stage in stages),
            ]
        )


def resident_mb() -> float:
    """Memory of this process."""
    return psutil.Process().memory_info().rss / 2**20


def many_keyframes(most: int) -> Iterator[str]:
    """A row per number of keyframes: what it takes to remember one, to look a view up, and to close a loop over all."""
    columns = ["to remember one, ms", "to look a view up, ms", "pose graph, s", "steps", "error before, m", "after, m"]
    yield row(["keyframes", *columns])
    yield row(["---:"] * (1 + len(columns)))
    generator = torch.Generator().manual_seed(0)
    ring(LOOKS, generator)  # the first is slow
    places, candidates = KeyframeDatabase(), Config().loop.candidates
    adding: list[float] = []
    for count in sorted({max(round(share * most), LOOKS) for share in SHARES}):
        while len(places) < count:
            seen = descriptors(generator)
            adding.append(clocked(partial(places.add, len(places), seen))[0])
        looks = (partial(places.query, nearly(seen, generator), candidates) for _ in range(LOOKS))
        asking = [clocked(look)[0] for look in looks]
        yield row([str(count), *(f"{1e3 * median(s[-LOOKS:]):.1f}" for s in (adding, asking)), *ring(count, generator)])


def descriptors(generator: torch.Generator) -> Tensor:
    """Of a keyframe, uint8, shape (N, 32): each bit a coin, which spreads them better than images do."""
    return torch.randint(256, (Config().features.count, 32), generator=generator, dtype=torch.uint8)


def nearly(seen: Tensor, generator: torch.Generator) -> Tensor:
    """The descriptors seen again: one bit in 16 is another."""
    flips = [torch.randint(256, seen.shape, generator=generator, dtype=torch.uint8) for _ in range(4)]
    return seen ^ reduce(torch.bitwise_and, flips)


def ring(count: int, generator: torch.Generator) -> tuple[str, str, str, str]:
    """Close a loop over cameras on a circle of 5 m that look outwards and drift, each tied to the next three."""
    turn = torch.zeros(6, dtype=torch.float64)
    turn[0], turn[4] = 2 * torch.pi * 5 / count, 2 * torch.pi / count  # along the circle, about the vertical
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
    seconds, found = clocked(partial(optimise_pose_graph, T_wc, *closed))
    before, after = ((T - T_true)[:, :3, 3].norm(dim=1).mean() for T in (T_wc, found.T_wc))
    return f"{seconds:.2f}", str(found.iterations), f"{before:.3f}", f"{after:.3f}"


def clocked(make: Callable[[], Made]) -> tuple[float, Made]:
    """Seconds that something takes, and the thing."""
    start = time.perf_counter()
    made = make()
    return time.perf_counter() - start, made


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_line("Time and memory of a long run and of many keyframes, as Markdown.")
    parser.add_argument("--seq", default="demo", help="sequence to play forth and back [demo]")
    parser.add_argument("--frames", type=int, default=5000, help="frames of the run [5000]")
    parser.add_argument("--keyframes", type=int, default=5000, help="most keyframes that are made up [5000]")
    return parser


def main() -> None:
    """Print both tables."""
    parser = arguments()
    options = parser.parse_args()
    if options.frames < BLOCKS or options.keyframes < LOOKS:
        parser.error(f"give at least --frames {BLOCKS} and --keyframes {LOOKS}")
    lines = [*heading(), "", f"## {options.seq}, forth and back", ""]
    try:
        sequence = load_sequence(located(options.seq, options.data_root), data_root=options.data_root)
        lines += long_run(sequence, options.frames)
    except V3DError as error:
        parser.error(str(error))
    lines += ["", "## Keyframes that are made up", "", *many_keyframes(options.keyframes)]
    publish(lines, options, parser)


if __name__ == "__main__":
    main()
