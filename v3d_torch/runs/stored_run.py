"""The result files of a run, read back (README, "Results")."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, ValidationError

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.config.validation import first_error
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.io.text import read_text
from v3d_torch.types import TrackingStatus, Trajectory

_METRICS = "metrics.json"

_DEPTH = 3
"""Folders between a run and the one above it that is given: a batch has sequence, configuration and seed."""


class Metrics(BaseModel):
    """What ``metrics.json`` says beside the scores; the names are its keys."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    sequence: str
    frames: int
    processed: int
    status: list[TrackingStatus]
    keyframes: int
    landmarks: int
    loops: int
    failure: str | None
    fps: float | None
    seconds: float
    seconds_per_stage: dict[str, float]
    peak_memory_mb: float | None
    seed: int
    masks: dict[str, Any] | None = None
    versions: dict[str, str]
    machine: dict[str, Any]


@dataclass(frozen=True)
class StoredRun:
    """A run as its files tell it.

    Attributes:
        folder: of the files.
        metrics: numbers of the whole run.
        trajectory: a pose for every frame that was processed; None where the file is missing or the run has no frame.
        keyframes: the poses that the map kept; None where there are none.
        groundtruth: true poses, if known.
        evaluation: scores; None without ground truth, or where fewer than three poses have any.
        frames: a row per frame; None where the file is missing.
        dynamics: a row per frame and object; None where the file is missing.
        config_text: the configuration as written; empty where the file is missing.
        config: the same; None where it is of a version with other keys, or missing.
    """

    folder: Path
    metrics: Metrics
    trajectory: Trajectory | None
    keyframes: Trajectory | None
    groundtruth: Trajectory | None
    evaluation: Evaluation | None
    frames: pa.Table | None
    dynamics: pa.Table | None
    config_text: str
    config: Config | None


def read_run(folder: Path, groundtruth: Path | None = None) -> StoredRun:
    """Read what a run left in its folder; all but ``metrics.json`` may be missing.

    Args:
        folder: given to the run as ``--out``.
        groundtruth: true poses to use instead of those in the folder.

    Raises:
        InputError: the folder holds no results, a file in it is broken, or the given true poses are of another time.
    """
    if not (folder / _METRICS).is_file():
        raise InputError(
            f"{folder}: holds no results of a run, there is no {_METRICS};"
            f" {suggest_folder(folder, _METRICS) or 'give the folder that run names at its end'}"
        )
    config_path = folder / "config.yaml"
    config_text = read_text(config_path, "it is a configuration in YAML") if config_path.is_file() else ""
    metrics, trajectory = read_metrics(folder / _METRICS), _read_poses(folder / "trajectory.txt")
    frames = len(metrics.status)
    if trajectory is not None and metrics.failure is not None:  # killed between writing the two: it has more poses
        trajectory = Trajectory(trajectory.stamps[:frames], trajectory.T_wc[:frames])
    if trajectory is not None and len(trajectory) != frames:
        raise InputError(
            f"{folder}: trajectory.txt has {len(trajectory)} poses, metrics.json {frames} frames; they are"
            " not of the same run, run again"
        )
    truth_path = groundtruth or folder / "groundtruth.txt"
    truth = read_trajectory(truth_path) if groundtruth is not None or truth_path.is_file() else None
    evaluation = None
    if truth is not None and trajectory is not None:
        try:
            evaluation = evaluate(truth, trajectory, frames=metrics.frames)
        except InputError as error:
            if groundtruth is not None:
                raise InputError(f"{groundtruth}: {error}") from error
    return StoredRun(
        folder=folder,
        metrics=metrics,
        trajectory=trajectory,
        keyframes=_read_poses(folder / "keyframes.txt"),
        groundtruth=truth,
        evaluation=evaluation,
        frames=_read_table(folder / "frames.parquet", ("frame", "stamp", "status", "keyframe")),
        dynamics=_read_table(
            folder / "dynamics.parquet", ("frame", "stamp", "id", "class", "votes", "chamfer", "motion_state", "missed")
        ),
        config_text=config_text,
        config=_read_config(config_path),
    )


def suggest_folder(path: Path, file: str) -> str | None:
    """Which folder to give instead of one that is none of a run: the one around a file, or the newest run below it.

    Args:
        path: that was given.
        file: name of the file that a run's folder has to have.

    Returns:
        What to do, in words; None where there is no such folder.
    """
    if path.is_file() and (path.parent / file).is_file():
        return f"give the folder that {path.name} is in, {path.parent}"
    found = [place for depth in range(1, _DEPTH + 1) for place in path.glob("*/" * depth + file)]
    if not found:
        return None
    # A name that points to the newest, as latest does, is as new as what it points to, and easier to type.
    newest = max(found, key=lambda place: (place.stat().st_mtime_ns, place.parent.is_symlink()))
    return f"give the newest of the runs in it, {newest.parent}"


def read_metrics(path: Path) -> Metrics:
    """Read the ``metrics.json`` of a run.

    Raises:
        InputError: it cannot be read, or is not what a run of this version writes.
    """
    text = read_text(path, "it is written by a run")
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}); run the sequence again") from error
    try:
        return Metrics.model_validate(tree)
    except ValidationError as error:
        raise InputError(f"{path}: {first_error(error)}; it is not of this version, run again") from error


def _read_poses(path: Path) -> Trajectory | None:
    """Poses of a run; it writes an empty file when it has none."""
    return read_trajectory(path) if path.is_file() and path.stat().st_size else None


def _read_table(path: Path, columns: tuple[str, ...]) -> pa.Table | None:
    if not path.is_file():
        return None
    try:
        table = pq.read_table(path)
        missing = set(columns) - set(table.column_names)  # which decodes the names
    except (pa.ArrowException, OSError, ValueError) as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: is no parquet table ({why}); run again") from error
    if missing:
        raise InputError(
            f"{path}: lacks the columns {', '.join(sorted(missing))}; it is not of this version, run again"
        )
    return table


def _read_config(path: Path) -> Config | None:
    try:
        return load_config(path) if path.is_file() else None
    except ConfigError:  # written by a version with other keys: it can be shown, not compared
        return None
