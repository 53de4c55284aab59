"""Reader of the result files of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.io.text import first_line
from v3d_torch.io.text_file import read_text
from v3d_torch.io.timestamps import format_timestamp
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.metrics_file import Metrics, read_metrics, suggest_folder
from v3d_torch.types import Trajectory


@dataclass(frozen=True)
class StoredRun:
    """Results of a run.

    Attributes:
        folder: Folder of the files.
        metrics: Content of ``metrics.json``.
        trajectory: Pose of each processed frame; None if the file is missing or the run has no frames.
        keyframes: Poses of the keyframes; None if there are none.
        groundtruth: True poses; None if there are none.
        evaluation: Scores; None without ground truth, if fewer than three poses have ground truth, or if the camera was
            not found in any frame.
        frames: Table with one row per frame; None if the file is missing.
        objects: Table with one row per frame and object; None if the file is missing.
        config_text: Text of the configuration file; empty if it is missing.
        config: Configuration; None if it is missing, or from a version with other keys.
    """

    folder: Path
    metrics: Metrics
    trajectory: Trajectory | None
    keyframes: Trajectory | None
    groundtruth: Trajectory | None
    evaluation: Evaluation | None
    frames: pa.Table | None
    objects: pa.Table | None
    config_text: str
    config: Config | None


def read_run(folder: Path, groundtruth: Path | None = None) -> StoredRun:
    """Read the results of a run; all files but ``metrics.json`` are optional.

    Args:
        folder: Folder of the results.
        groundtruth: File of true poses to use instead of those in the folder.

    Raises:
        InputError: If the folder has no results, a file is damaged, or the given ground truth has too few timestamps in
            common with the trajectory.
    """
    if not (folder / RunFile.METRICS).is_file():
        problem = f"has no results of a run ({RunFile.METRICS} is missing)" if folder.is_dir() else "is not a folder"
        raise InputError(
            f"{folder}: {problem};"
            f" {suggest_folder(folder, RunFile.METRICS) or 'pass the folder that the run printed at its end'}"
        )
    config_path = folder / RunFile.CONFIG
    config_text = read_text(config_path, "it is a configuration in YAML") if config_path.is_file() else ""
    metrics, trajectory = read_metrics(folder / RunFile.METRICS), _read_poses(folder / RunFile.TRAJECTORY)
    frames = len(metrics.status)
    if trajectory is not None and metrics.failure is not None:
        # If the run was killed after it wrote the trajectory and before metrics.json, the trajectory has more poses.
        trajectory = trajectory.select(slice(frames))
    if trajectory is not None and len(trajectory) != frames:
        raise InputError(
            f"{folder}: trajectory.txt has {len(trajectory)} poses and metrics.json {frames} frames, so they belong to"
            " different runs; run the sequence again"
        )
    truth_path = groundtruth or folder / RunFile.GROUNDTRUTH
    truth = read_trajectory(truth_path) if groundtruth is not None or truth_path.is_file() else None
    evaluation = None
    if truth is not None and trajectory is not None and metrics.was_found:
        try:
            is_localised = torch.tensor([status.is_localised for status in metrics.status])
            evaluation = evaluate(truth, trajectory, frames=metrics.frames, is_localised=is_localised)
        except InputError as error:
            if groundtruth is not None:
                raise InputError(f"{groundtruth}: {error}") from error
    tables = {
        RunFile.FRAMES: _read_table(folder / RunFile.FRAMES, ("frame", "stamp", "status", "keyframe")),
        RunFile.OBJECTS: _read_table(
            folder / RunFile.OBJECTS, ("frame", "stamp", "id", "class", "votes", "chamfer", "motion_state", "missed")
        ),
    }
    if trajectory is not None and metrics.failure is None:
        _check_stamps(folder, trajectory.stamps, tables)
    return StoredRun(
        folder=folder,
        metrics=metrics,
        trajectory=trajectory,
        keyframes=_read_poses(folder / RunFile.KEYFRAMES),
        groundtruth=truth,
        evaluation=evaluation,
        frames=tables[RunFile.FRAMES],
        objects=tables[RunFile.OBJECTS],
        config_text=config_text,
        config=_read_config(config_path),
    )


def _check_stamps(folder: Path, stamps: Tensor, tables: Mapping[RunFile, pa.Table | None]) -> None:
    """Check that the tables of a run have the timestamps of its trajectory: one row for each frame, or for each object.

    Raises:
        InputError: If a table is from another run.
    """
    known = set(map(format_timestamp, stamps.tolist()))  # the precision of trajectory files
    for file, table in tables.items():
        if table is None:
            continue
        found = set(map(format_timestamp, table["stamp"].to_pylist()))
        if not found <= known or (file is RunFile.FRAMES and len(table) != len(stamps)):
            raise InputError(
                f"{folder}: {file} and trajectory.txt have other timestamps, so they belong to different runs; run the"
                " sequence again"
            )


def _read_poses(path: Path) -> Trajectory | None:
    """Read poses; a run without poses writes an empty file."""
    return read_trajectory(path) if path.is_file() and path.stat().st_size else None


def _read_table(path: Path, columns: tuple[str, ...]) -> pa.Table | None:
    if not path.is_file():
        return None
    try:
        table = pq.read_table(path)
        missing = set(columns) - set(table.column_names)  # decodes the names, which can fail
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: is not a parquet table ({first_line(error)}); run the sequence again") from error
    if missing:
        raise InputError(
            f"{path}: has no columns {', '.join(sorted(missing))}; the file is from another version, run the sequence"
            " again"
        )
    return table


def _read_config(path: Path) -> Config | None:
    try:
        return load_config(path) if path.is_file() else None
    except ConfigError:  # of a version with other keys; it is shown, but not compared
        return None
