"""Runs of systems, each in a new process, so that threads, memory, output and crashes do not affect other runs."""

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

TIMEOUT = 3600
"""Timeout of a process, seconds; a process that takes longer is considered to hang."""


class SystemRunError(Exception):
    """Failure of a system; the message is its last line of error output."""


@dataclass(frozen=True)
class Measured:
    """Result of one run.

    Attributes:
        trajectory: Poses; None if there is no pose.
        frames: Number of frames that the system tracked or tried to track.
        seconds: Wall time from before the first frame is read until the last one has a pose.
        cpu_seconds: User and system time of all threads of its processes in that time.
        stages: Seconds by stage; empty if the system does not measure them.
    """

    trajectory: Trajectory | None
    frames: int
    seconds: float
    cpu_seconds: float
    stages: dict[str, float]


def measure(
    system: str,
    sequence: str,
    data_root: Path,
    *,
    frames: int | None = None,
    seed: int = 0,
    vocabulary: Path | None = None,
    rate: float | None = None,
) -> Measured:
    """Run a system on the first frames of a sequence.

    Args:
        system: One of `systems.OURS` and `systems.PEERS`.
        sequence: Sequence, as `load_sequence` takes it.
        data_root: Folder of sequences.
        frames: Number of frames; None for all.
        seed: Seed, for systems that have one.
        vocabulary: Vocabulary of ORB-SLAM3.
        rate: Speed at which ORB-SLAM3 gets the frames, relative to that of the recording; None for full speed.

    Raises:
        SystemRunError: If the system failed, crashed or hung.
    """
    options = {"--frames": frames, "--vocabulary": vocabulary, "--rate": rate, "--seed": seed, "--data-root": data_root}
    given = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    here = str(Path(__file__).parent.parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))}
    with TemporaryDirectory() as out:
        # -P: the installed package, not one in the working folder.
        command = [sys.executable, "-P", "-m", "systems.child", system, "--seq", sequence, "--out", out, *given]
        try:
            done = subprocess.run(  # noqa: S603
                command, capture_output=True, text=True, errors="replace", env=environment, timeout=TIMEOUT
            )
        except subprocess.TimeoutExpired as error:
            raise SystemRunError(f"not finished after {TIMEOUT} s") from error
        if done.returncode:
            raise SystemRunError(failure(done).replace(out, "its temporary folder"))
        figures = json.loads((Path(out) / "measured.json").read_text(encoding="utf-8"))
        path = Path(out) / "trajectory.txt"
        return Measured(read_trajectory(path) if path.stat().st_size else None, **figures)


def failure(done: subprocess.CompletedProcess[str]) -> str:
    """Return the error message of a failed run."""
    if done.returncode < 0:
        return f"killed by {signal.Signals(-done.returncode).name}"
    lines = done.stderr.strip().splitlines()
    return lines[-1].removeprefix("error: ") if lines else f"exit code {done.returncode} without a message"
