"""Sequences and jobs for tests of batches."""

from __future__ import annotations

import shutil
from pathlib import Path

from v3d_torch.batch.job import Job
from v3d_torch.batch.plan import load_configs, plan_jobs
from v3d_torch.config import Config
from v3d_torch.runs.open_sequences import OpenedSequence
from v3d_torch.runs.request import RunRequest

ENDLESS = 2000
"""Number of frames of a sequence that does not end before an interrupt, however busy the machine is."""


def repeat_sequence(moment: Path, folder: Path, frames: int) -> Path:
    """Write a sequence that plays the frames of `moment` forwards and backwards, without ground truth.

    Args:
        moment: Sequence to take the frames from.
        folder: Folder to write.
        frames: Number of frames.
    """
    folder.mkdir(exist_ok=True)
    for name in ("rgb", "depth", "camera.yaml"):
        if not (folder / name).exists():
            (folder / name).symlink_to(moment / name)
    pairs = [line.split() for line in (moment / "associations.txt").read_text().splitlines()]
    back_and_forth = [*pairs, *reversed(pairs)]
    rows = [(k / 30, *back_and_forth[k % len(back_and_forth)]) for k in range(frames)]
    lines = [f"{stamp:.6f} {colour} {stamp:.6f} {depth}" for stamp, _, colour, _, depth in rows]
    (folder / "associations.txt").write_text("\n".join(lines) + "\n")
    return folder


def without_camera_and_stamps(moment: Path, folder: Path) -> tuple[Path, Path]:
    """Write a sequence whose images are numbered, and the camera into a file elsewhere.

    Args:
        moment: Sequence to take the frames from.
        folder: Folder to write.

    Returns:
        Folder of the sequence and file of the camera.
    """
    for name in ("rgb", "depth"):
        (folder / "numbered" / name).mkdir(parents=True)
        for index, image in enumerate(sorted((moment / name).iterdir())):
            shutil.copy(image, folder / "numbered" / name / f"{index:04d}.png")
    shutil.copy(moment / "camera.yaml", folder / "mine.yaml")
    return folder / "numbered", folder / "mine.yaml"


def plan_seeds(sequence: Path, out: Path, seeds: int) -> list[Job]:
    """Plan jobs of the baseline on a sequence, one per seed."""
    request = RunRequest(str(sequence), Config())
    opened = OpenedSequence(request, request.load_sequence())
    configs = load_configs(["baseline"], one_thread=True)
    return plan_jobs({opened.sequence.name: opened}, configs, seeds=seeds, folder=out)
