"""Writer of the result files of a run; docs/results.md documents every file, key and column."""

from __future__ import annotations

import io
import json
import logging
import platform
import re
import sys
from collections.abc import Sized
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import torch

from v3d_torch.config.loading import dump_config
from v3d_torch.datasets.tum_extents import describe_difference
from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.errors import InputError
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.geometry.se3 import invert
from v3d_torch.io.files import atomic_write, write_text
from v3d_torch.io.ply import write_ply
from v3d_torch.mapping.keyframe import stack_poses
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.occupancy.map_server import write_map_server_files
from v3d_torch.occupancy.occupancy_grid import occupancy_grid
from v3d_torch.occupancy.occupancy_io import save_occupancy
from v3d_torch.occupancy.occupancy_mapper import OccupancyMapper
from v3d_torch.occupancy.octomap_file import write_octomap
from v3d_torch.pipeline import Pipeline
from v3d_torch.pipeline.run_record import ObjectTable
from v3d_torch.reconstruction.mesh import fuse_mesh
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runs.state_table import make_state_table
from v3d_torch.segmentation.coco import class_name
from v3d_torch.types import TrackingStatus, Trajectory
from v3d_torch.viz.camera_path import make_camera_path
from v3d_torch.viz.run_figures import draw_run

if sys.platform != "win32":
    import resource

_LOG = logging.getLogger(__name__)

_LIBRARIES = ("torch", "kornia", "kornia-rs", "numpy", "onnxruntime", "opencv-python-headless", "pypose", "faiss-cpu")

_STATE_COLUMNS = (
    *("vx", "vy", "vz", "position_sigma", "velocity_sigma"),
    *("box_x", "box_y", "box_z", "box_length", "box_width", "box_height", "box_yaw"),
)
"""Columns of velocity, uncertainty and box of an object."""

_DYNAMICS = pa.schema(
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


def write_results(folder: Path, pipeline: Pipeline, point_map: PointMap) -> Evaluation | None:
    """Write all results of a run, ``metrics.json`` last, so that its presence shows that they are complete.

    Args:
        folder: Folder of the results; made if it is missing.
        pipeline: Pipeline that has run, to the end of the sequence or not.
        point_map: Point map of the static scene, from `Pipeline.flush`.

    Returns:
        The scores, if there is ground truth.

    Raises:
        OutputError: If the folder cannot be written or the disk is full.
    """
    trajectory, evaluation = _write_tables(folder, pipeline)
    _write_maps(folder, pipeline, trajectory, point_map)
    draw_run(folder / "figures", pipeline, trajectory, point_map)
    _write_metrics(folder, pipeline, evaluation, pipeline.record.failure)
    return evaluation


def write_intermediate_results(folder: Path, pipeline: Pipeline) -> None:
    """Write the results so far of a run in progress, without maps and figures, which take seconds.

    Args:
        folder: Folder of the results; made if it is missing.
        pipeline: Pipeline between two frames.

    Raises:
        OutputError: If the folder cannot be written or the disk is full.
    """
    _, evaluation = _write_tables(folder, pipeline)
    done = len(pipeline.slam.poses)
    total = f" of {len(pipeline.sequence)}" if isinstance(pipeline.sequence, Sized) else ""
    _write_metrics(folder, pipeline, evaluation, f"killed or still running after {done}{total} frames")


def _write_tables(folder: Path, pipeline: Pipeline) -> tuple[Trajectory, Evaluation | None]:
    """Write poses and tables of all frames so far; return the trajectory, and the scores if there is ground truth."""
    slam, sequence = pipeline.slam, pipeline.sequence
    trajectory = slam.poses.trajectory()
    write_trajectory(folder / "trajectory.txt", trajectory)  # first, in case the disk gets full
    write_text(folder / "config.yaml", dump_config(slam.config))
    keyframes = [keyframe for keyframe in slam.map.active_keyframes if not keyframe.is_from_earlier_run]
    stamps = torch.tensor([keyframe.stamp for keyframe in keyframes], dtype=torch.float64)
    write_trajectory(folder / "keyframes.txt", Trajectory(stamps, invert(stack_poses(keyframes))))
    evaluation = None
    if sequence.groundtruth is not None:
        write_trajectory(folder / "groundtruth.txt", sequence.groundtruth)
        with suppress(InputError):  # too few poses for scores
            evaluation = evaluate(sequence.groundtruth, trajectory, frames=pipeline.frame_count)
    _write_table(folder / "frames.parquet", _frame_table(pipeline))
    _write_table(folder / "states.parquet", make_state_table(pipeline.record))
    _write_table(folder / "dynamics.parquet", _object_table(pipeline.record.dynamics))
    return trajectory, evaluation


def _write_metrics(folder: Path, pipeline: Pipeline, evaluation: Evaluation | None, failure: str | None) -> None:
    write_text(folder / "metrics.json", json.dumps(_metrics(pipeline, evaluation, failure), indent=2) + "\n")


def _frame_table(pipeline: Pipeline) -> pa.Table:
    """Return the table of frames: status, keyframe, and wall and CPU time of each stage, 0 if it did not run."""
    slam, times = pipeline.slam, pipeline.record.times
    keyframes = torch.tensor([keyframe.frame for keyframe in slam.map.active_keyframes], dtype=torch.int64)
    statuses = [status.value for status in slam.poses.statuses][: len(times)]  # one more if a frame was interrupted
    wall, cpu = times.wall.T.numpy(), times.cpu.T.numpy()
    columns = {
        "frame": times.indices.numpy(),
        "stamp": times.stamps.numpy(),
        "status": pa.array(statuses, pa.string()),
        "keyframe": torch.isin(times.indices, keyframes).numpy(),
        **{f"seconds_{stage}": seconds for stage, seconds in zip(times.stages, wall, strict=True)},
        **{f"cpu_seconds_{stage}": seconds for stage, seconds in zip(times.stages, cpu, strict=True)},
    }
    return pa.table(columns)


def _object_table(dynamics: ObjectTable) -> pa.Table:
    """Return the table of objects: one row per frame and object."""
    x, y, z = dynamics["centroid"].T
    state = torch.cat([dynamics["velocity"], dynamics["sigmas"], dynamics["box"]], dim=1)
    states = [state.value for state in MotionState]
    columns = {
        "frame": dynamics["frame"],
        "stamp": dynamics["stamp"],
        "id": dynamics["id"],
        "class": [class_name(label) for label in dynamics["label"].tolist()],
        "x": x,
        "y": y,
        "z": z,
        **dict(zip(_STATE_COLUMNS, state.T, strict=True)),
        "votes": dynamics["votes"],
        "chamfer": dynamics["chamfer"],
        "motion_state": [states[code] for code in dynamics["motion_state"].tolist()],
        "missed": dynamics["missed"],
    }
    arrays = {name: column if isinstance(column, list) else column.numpy() for name, column in columns.items()}
    return pa.table(arrays, schema=_DYNAMICS)


def _write_table(path: Path, table: pa.Table) -> None:
    content = io.BytesIO()  # so that Python, and not pyarrow, writes the file and raises the errors
    pq.write_table(table, content)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.getvalue())


def _metrics(pipeline: Pipeline, evaluation: Evaluation | None, failure: str | None) -> dict[str, object]:
    slam, run = pipeline.slam, pipeline.record
    statuses = slam.poses.statuses
    frames = len(statuses)
    counts = {status.value: statuses.count(status) for status in TrackingStatus}
    masks = run.mask_evaluation.compute_scores()
    return {
        **(evaluation.to_dict() if evaluation is not None else {"ate": None, "rpe": None}),
        "masks": masks.to_dict() if masks is not None else None,
        "sequence": pipeline.sequence.name,
        "difference": describe_difference(pipeline.sequence),
        "frames": pipeline.frame_count,
        "processed": frames,
        "skipped": len(run.broken),
        **counts,
        "status": [status.value for status in statuses],
        "keyframes": sum(not keyframe.is_from_earlier_run for keyframe in slam.map.active_keyframes),
        "known_keyframes": sum(keyframe.is_from_earlier_run for keyframe in slam.map.active_keyframes),
        "landmarks": int(slam.map.landmarks["active"].sum()),
        "loops": slam.loop_closer.loop_count,
        "readout": slam.map.readout.seconds,
        "readout_sigma": slam.map.readout.sigma,
        "warnings": run.warnings,
        "gravity": None if slam.gravity is None else slam.gravity.tolist(),
        "T_lw": None if (T_lw := slam.T_lw) is None else T_lw.tolist(),
        "failure": failure,
        "latency": run.live.latency_statistics(),
        "dropped": run.live.dropped,
        "rejected": run.rejected,
        "fps": frames / run.seconds if run.seconds else None,
        "seconds": run.seconds,
        "seconds_per_stage": dict(slam.timer.seconds),
        "peak_memory_mb": _peak_memory_mb(),
        "seed": slam.config.seed,
        "stages": slam.config.stages.paths,
        "versions": _versions(),
        "machine": {"processor": platform.machine(), "system": platform.system(), "threads": slam.config.threads},
    }


@cache
def _versions() -> dict[str, str | None]:
    """Return the versions of the package, of Python and of the libraries; None for those that are not installed."""
    python = platform.python_version()
    return {"v3d-torch": _version("v3d-torch"), "python": python, **{name: _version(name) for name in _LIBRARIES}}


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:  # another distribution has the same module, as onnxruntime-gpu
        return None


def _peak_memory_mb() -> float | None:
    if sys.platform == "win32":
        return None
    if (status := Path("/proc/self/status")).is_file():  # on Linux getrusage includes the parent process
        found = re.search(r"^VmHWM:\s*(\d+) kB$", status.read_text(encoding="utf-8"), re.MULTILINE)
        if found is not None:
            return int(found[1]) / (1 << 10)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def _write_maps(folder: Path, pipeline: Pipeline, trajectory: Trajectory, point_map: PointMap) -> None:
    slam, views = pipeline.slam, pipeline.views
    write_ply(folder / "map.ply", point_map.points, point_map.colours, normals=point_map.normals)
    if slam.config.dense_map.mesh.enabled:
        mesh = fuse_mesh(views, slam.config.dense_map)
        write_ply(folder / "mesh.ply", mesh.vertices, mesh.colours, normals=mesh.normals, faces=mesh.faces)
    if slam.occupancy is not None:
        _write_occupancy(folder, slam.occupancy)
    keyframes = slam.map.active_keyframes
    stamps = torch.tensor([keyframe.stamp for keyframe in keyframes], dtype=torch.float64)
    known = torch.tensor([keyframe.is_from_earlier_run for keyframe in keyframes], dtype=torch.bool)
    positions = torch.searchsorted(trajectory.stamps, stamps).masked_fill(known, -1)
    statuses = [status.value for status in slam.poses.statuses]
    path = make_camera_path(trajectory, statuses, invert(stack_poses(keyframes)), positions, pipeline.sequence.camera)
    write_ply(folder / "trajectory.ply", path.points, path.colours, faces=path.faces, edges=path.edges)


def _write_occupancy(folder: Path, mapper: OccupancyMapper) -> None:
    """Write the occupancy map, and its 2D grid if a floor is visible."""
    floor = mapper.find_floor()
    save_occupancy(folder / "occupancy.npz", mapper.map, floor)
    write_octomap(folder / "occupancy.bt", mapper.map)
    if floor is None:
        _LOG.warning("occupancy map: no floor is visible; no 2D grid was written")
    else:
        write_map_server_files(folder / "map.yaml", occupancy_grid(mapper.map, floor))
