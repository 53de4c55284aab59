"""Poses and tables of a run; docs/results.md documents every file and column."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import torch
from torch import Tensor

from v3d_torch.config.loading import dump_config
from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.errors import InputError
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.geometry.se3 import invert
from v3d_torch.io.files import write_text
from v3d_torch.io.parquet_file import write_parquet
from v3d_torch.mapping.keyframe import stack_poses
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.pipeline import Pipeline
from v3d_torch.pipeline.run_record import ObjectTable
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.state_table import make_state_table
from v3d_torch.segmentation.coco import class_name
from v3d_torch.types import Trajectory

_STATE_COLUMNS = (
    "vx", "vy", "vz", "position_sigma", "velocity_sigma",
    "box_x", "box_y", "box_z", "box_length", "box_width", "box_height", "box_yaw",
)  # fmt: skip
"""Columns of velocity, uncertainty and box of an object."""

_OBJECTS = pa.schema(
    [
        ("frame", pa.int64()),
        ("stamp", pa.float64()),
        ("id", pa.int64()),
        ("class", pa.string()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("z", pa.float64()),
        *((name, pa.float64()) for name in _STATE_COLUMNS),
        ("votes", pa.int64()),
        ("chamfer", pa.float64()),
        ("motion_state", pa.string()),
        ("missed", pa.bool_()),
    ]
)


@dataclass(frozen=True)
class ResultTables:
    """Poses and tables of all frames so far. They stay as they are while the run continues.

    Attributes:
        trajectory: Poses of all frames.
        keyframes: Poses of the keyframes of the run.
        groundtruth: True poses, if there are any.
        evaluation: Scores, if there is ground truth, the camera was found, and there are enough poses.
        evaluation_error: Why there are no scores although there is ground truth and the camera was found; else None.
        config: Configuration, YAML.
        frames: Table of frames.
        states: Table of the states of the camera.
        objects: Table of objects.
    """

    trajectory: Trajectory
    keyframes: Trajectory
    groundtruth: Trajectory | None
    evaluation: Evaluation | None
    evaluation_error: str | None
    config: str
    frames: pa.Table
    states: pa.Table
    objects: pa.Table

    def write(self, folder: Path) -> None:
        """Write all files to a folder, which is made if it is missing.

        Raises:
            OutputError: If the folder cannot be written or the disk is full.
        """
        write_trajectory(folder / RunFile.TRAJECTORY, self.trajectory)  # first, in case the disk gets full
        write_text(folder / RunFile.CONFIG, self.config)
        write_trajectory(folder / RunFile.KEYFRAMES, self.keyframes)
        if self.groundtruth is not None:
            write_trajectory(folder / RunFile.GROUNDTRUTH, self.groundtruth)
        write_parquet(folder / RunFile.FRAMES, self.frames)
        write_parquet(folder / RunFile.STATES, self.states)
        write_parquet(folder / RunFile.OBJECTS, self.objects)


def collect_tables(pipeline: Pipeline) -> ResultTables:
    """Collect poses and tables of all frames so far, between two frames."""
    slam, groundtruth = pipeline.slam, pipeline.sequence.groundtruth
    trajectory = slam.poses.trajectory()
    keyframes = slam.map.own_keyframes
    stamps = torch.tensor([keyframe.stamp for keyframe in keyframes], dtype=torch.float64)
    evaluation, evaluation_error = None, None
    if groundtruth is not None and slam.poses.was_found:
        try:
            evaluation = evaluate(
                groundtruth, trajectory, frames=pipeline.frame_count, is_localised=slam.poses.localised
            )
        except InputError as error:
            evaluation_error = str(error)
    return ResultTables(
        trajectory=trajectory,
        keyframes=Trajectory(stamps, invert(stack_poses(keyframes))),
        groundtruth=groundtruth,
        evaluation=evaluation,
        evaluation_error=evaluation_error,
        config=dump_config(slam.config),
        frames=_frame_table(pipeline, stamps),
        states=make_state_table(pipeline.record),
        objects=_object_table(pipeline.record.objects),
    )


def _frame_table(pipeline: Pipeline, keyframes: Tensor) -> pa.Table:
    """Return the table of frames: status, keyframe, and wall and CPU time of each stage, 0 if it did not run.

    Args:
        pipeline: Pipeline between two frames.
        keyframes: Timestamps of the keyframes, seconds, float64, shape (K,).
    """
    slam, times = pipeline.slam, pipeline.record.times
    statuses = slam.poses.statuses[: len(times)]  # one more if a frame was interrupted
    wall, cpu = times.wall.T.numpy(), times.cpu.T.numpy()
    columns = {
        "frame": times.indices.numpy(),
        "stamp": times.stamps.numpy(),
        "status": pa.array(statuses, pa.string()),
        "keyframe": torch.isin(times.stamps, keyframes).numpy(),
        **{f"seconds_{stage}": seconds for stage, seconds in zip(times.stages, wall, strict=True)},
        **{f"cpu_seconds_{stage}": seconds for stage, seconds in zip(times.stages, cpu, strict=True)},
    }
    return pa.table(columns)


def _object_table(objects: ObjectTable) -> pa.Table:
    """Return the table of objects: one row per frame and object."""
    x, y, z = objects["centroid"].T
    state = torch.cat([objects["velocity"], objects["sigmas"], objects["box"]], dim=1)
    motion_states, labels = [state.value for state in MotionState], objects["label"]
    classes = {label: class_name(label) for label in labels.unique().tolist()}
    columns = {
        "frame": objects["frame"],
        "stamp": objects["stamp"],
        "id": objects["id"],
        "class": [classes[label] for label in labels.tolist()],
        "x": x,
        "y": y,
        "z": z,
        **dict(zip(_STATE_COLUMNS, state.T, strict=True)),
        "votes": objects["votes"],
        "chamfer": objects["chamfer"],
        "motion_state": [motion_states[code] for code in objects["motion_state"].tolist()],
        "missed": objects["missed"],
    }
    arrays = {name: column if isinstance(column, list) else column.numpy() for name, column in columns.items()}
    return pa.table(arrays, schema=_OBJECTS)
