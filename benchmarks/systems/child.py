"""Process of a system: ``python -m systems.child pyorbslam3 --seq ... --out FOLDER``; see `process`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

import psutil
from replay import Replay

from systems import OURS, PEERS
from systems.base import System
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.errors import V3DError
from v3d_torch.runtime.imports import quick_imports


def prepare(name: str, sequence: RGBDSequence, seed: int, vocabulary: Path | None, rate: float | None) -> System:
    """Load a system and only its own libraries."""
    if name in OURS:
        with quick_imports():  # as v3d_torch/cli/run.py
            from systems.ours import Ours

        return Ours(sequence, name, seed)
    if name == "pyorbslam3":
        from systems.orbslam3 import OrbSlam3

        return OrbSlam3(sequence, vocabulary, rate)
    from systems.open3d_odometry import Open3DOdometry

    return Open3DOdometry(sequence)


def cpu_time() -> float:
    """Return the CPU time of all threads of this process and its child processes, seconds."""
    times = os.times()
    ended = times.user + times.system + times.children_user + times.children_system
    running = [child.cpu_times() for child in psutil.Process().children(recursive=True)]
    return ended + sum(child.user + child.system for child in running)


def main() -> None:
    """Run the system; write its trajectory and times."""
    parser = argparse.ArgumentParser()
    parser.add_argument("system", choices=[*OURS, *PEERS])
    parser.add_argument("--seq", required=True)
    parser.add_argument("--data-root", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--vocabulary", type=Path)
    parser.add_argument("--rate", type=float)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()

    sequence = load_sequence(options.seq, data_root=options.data_root)
    if options.frames is not None and options.frames < len(sequence):
        sequence = Replay(sequence, range(options.frames))
    system = prepare(options.system, sequence, options.seed, options.vocabulary, options.rate)
    start, cpu_start = time.perf_counter(), cpu_time()
    system()
    seconds, cpu_seconds = time.perf_counter() - start, cpu_time() - cpu_start
    write_trajectory(options.out / "trajectory.txt", system.trajectory())
    figures = {
        "frames": len(sequence),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "stages": dict(system.stages),
    }
    (options.out / "measured.json").write_text(json.dumps(figures), encoding="utf-8")
    os._exit(0)  # without destructors, because those of ORB-SLAM3 can crash


if __name__ == "__main__":
    try:
        main()
    except (V3DError, ImportError, RuntimeError) as error:
        sys.exit(f"error: {error}")
