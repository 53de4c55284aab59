"""A contender in a process of its own: its threads, memory, output and crashes are no one else's."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.types import Trajectory

LONGEST = 3600
"""Seconds after which a process is taken to hang."""


class ContenderError(Exception):
    """A contender failed; the message is the sentence that it ended with."""


@dataclass(frozen=True)
class Measured:
    """What one run gave.

    Attributes:
        trajectory: None where it found no pose.
        frames: of the sequence that were given to it.
        seconds: from before the first frame is read until the last has a pose.
        cpu_seconds: of all threads of its processes in that time, user and system.
        stages: seconds by stage, where it tells them.
    """

    trajectory: Trajectory | None
    frames: int
    seconds: float
    cpu_seconds: float
    stages: dict[str, float]


def measure(
    contender: str,
    sequence: str,
    data_root: Path,
    *,
    frames: int | None = None,
    seed: int = 0,
    vocabulary: Path | None = None,
) -> Measured:
    """Run a contender on the first frames of a sequence.

    Args:
        contender: one of `contenders.OURS` and `contenders.PEERS`.
        sequence: as ``load_sequence`` takes it.
        data_root: where sequences are.
        frames: how many; None for all.
        seed: for those who take one.
        vocabulary: for ORB-SLAM3.

    Raises:
        ContenderError: it failed, crashed or hung.
    """
    options = {"--frames": frames, "--vocabulary": vocabulary, "--seed": seed, "--data-root": data_root}
    given = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    here = str(Path(__file__).parent.parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))}
    with TemporaryDirectory() as out:
        # -P: the package that is installed, not one that the working folder may hold.
        command = [sys.executable, "-P", "-m", "contenders.child", contender, "--seq", sequence, "--out", out, *given]
        try:
            done = subprocess.run(  # noqa: S603
                command, capture_output=True, text=True, errors="replace", env=environment, timeout=LONGEST
            )
        except subprocess.TimeoutExpired as error:
            raise ContenderError(f"gave nothing in {LONGEST} s") from error
        if done.returncode:
            raise ContenderError(failure(done).replace(out, "its temporary folder"))
        figures = json.loads((Path(out) / "measured.json").read_text(encoding="utf-8"))
        path = Path(out) / "trajectory.txt"
        return Measured(read_trajectory(path) if path.stat().st_size else None, **figures)


def failure(done: subprocess.CompletedProcess[str]) -> str:
    """The sentence that a failed run ended with."""
    if done.returncode < 0:
        return f"killed by {signal.Signals(-done.returncode).name}"
    lines = done.stderr.strip().splitlines()
    return lines[-1].removeprefix("error: ") if lines else f"exit code {done.returncode} without a word"
