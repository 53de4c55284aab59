"""Writer of the result files of a run; docs/results.md documents every file, key and column."""

from __future__ import annotations

import json
import logging
import platform
import re
import sys
from collections.abc import Callable, Sized
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.sequence_digest import sequence_digest
from v3d_torch.datasets.tum_extents import describe_difference
from v3d_torch.evaluation import Evaluation
from v3d_torch.evaluation.evaluation import absent_scores, note_too_few_poses
from v3d_torch.geometry.se3 import invert
from v3d_torch.io.files import write_text
from v3d_torch.io.ply import write_ply
from v3d_torch.mapping.keyframe import stack_poses
from v3d_torch.occupancy.map_server import write_map_server_files
from v3d_torch.occupancy.occupancy_grid import occupancy_grid
from v3d_torch.occupancy.occupancy_io import save_occupancy
from v3d_torch.occupancy.occupancy_mapper import OccupancyMapper
from v3d_torch.occupancy.octomap_file import write_octomap
from v3d_torch.pipeline import Pipeline
from v3d_torch.reconstruction.mesh import fuse_mesh
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runs.diagnosis import check_lost_frames, diagnose
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_tables import ResultTables, collect_tables
from v3d_torch.runs.run_figures import draw_run
from v3d_torch.types import TrackingStatus, Trajectory
from v3d_torch.viz.camera_path import make_camera_path

if sys.platform != "win32":
    import resource

_LOG = logging.getLogger(__name__)

_KERNEL_KB = 1024
"""Bytes in what kernels call a kB; a megabyte of the results has a million bytes."""

_LIBRARIES = ("torch", "kornia", "kornia-rs", "numpy", "onnxruntime", "opencv-python-headless", "pypose", "faiss-cpu")


def write_results(folder: Path, pipeline: Pipeline, request: RunRequest | None = None) -> Evaluation | None:
    """Write all results of a run; once they are complete, ``metrics.json`` no longer names a failure.

    Poses and tables are written before the point map is fused, so that they are not lost if the memory does not suffice
    to fuse it.

    Args:
        folder: Folder of the results; made if it is missing.
        pipeline: Pipeline that has run, to the end of the sequence or not, after `Pipeline.flush`.
        request: Inputs of the run, with which incomplete results are explained in ``pipeline.record.diagnosis``; None
            for no explanation.

    Returns:
        The scores, if there is ground truth.

    Raises:
        OutputError: If the folder cannot be written or the disk is full.
    """
    tables, record = collect_tables(pipeline), pipeline.record
    metrics = _metrics(pipeline, tables.evaluation)
    _write_tables(folder, tables, metrics)
    point_map = pipeline.fuse_points()
    if request is not None and record.failure is None:
        pipeline.warn(check_lost_frames(pipeline))
        record.diagnosis = diagnose(pipeline, request, tables.evaluation_error)
    _write_maps(folder, pipeline, tables.trajectory, point_map)
    draw_run(folder, pipeline, tables.trajectory, point_map)
    metrics |= {"failure": record.failure, "diagnosis": record.diagnosis, "warnings": record.warnings}
    metrics["peak_memory_mb"] = _peak_memory_mb()
    _write_metrics(folder, metrics)
    return tables.evaluation


def prepare_intermediate_results(folder: Path, pipeline: Pipeline) -> Callable[[], None]:
    """Collect the results so far of a run in progress or of one that failed, without maps and figures.

    Args:
        folder: Folder of the results; made if it is missing.
        pipeline: Pipeline between two frames.

    Returns:
        Function that writes the results and raises `OutputError`. It takes seconds after a long run; the pipeline can
        continue meanwhile in another thread.
    """
    tables = collect_tables(pipeline)
    return partial(_write_tables, folder, tables, _metrics(pipeline, tables.evaluation))


def _write_tables(folder: Path, tables: ResultTables, metrics: dict[str, object]) -> None:
    tables.write(folder)
    _write_metrics(folder, metrics)


def _write_metrics(folder: Path, metrics: dict[str, object]) -> None:
    write_text(folder / RunFile.METRICS, json.dumps(metrics, indent=2) + "\n")


def _metrics(pipeline: Pipeline, evaluation: Evaluation | None) -> dict[str, object]:
    """Return the metrics of a run whose results are not complete yet."""
    slam, run = pipeline.slam, pipeline.record
    statuses = slam.poses.statuses
    frames = len(statuses)
    counts = {status.value: statuses.count(status) for status in TrackingStatus}
    masks = run.mask_evaluation.compute_scores()
    notes = note_too_few_poses(pipeline.sequence.groundtruth, frames)
    total = f" of {len(pipeline.sequence)}" if isinstance(pipeline.sequence, Sized) else ""
    return {
        **(absent_scores(frames, pipeline.frame_count, notes) if evaluation is None else evaluation.to_dict()),
        "masks": masks.to_dict() if masks is not None else None,
        "sequence": pipeline.sequence.name,
        "difference": describe_difference(pipeline.sequence),
        "sequence_digest": sequence_digest(pipeline.sequence) if isinstance(pipeline.sequence, RGBDSequence) else None,
        "frames": pipeline.frame_count,
        "processed": frames,
        "skipped": len(run.broken),
        **counts,
        "status": statuses,
        "keyframes": len(slam.map.own_keyframes),
        "known_keyframes": sum(keyframe.is_from_earlier_run for keyframe in slam.map.active_keyframes),
        "landmarks": int(slam.map.landmarks["active"].sum()),
        "loops": slam.loop_closer.loop_count,
        "readout": slam.map.readout.seconds,
        "readout_sigma": slam.map.readout.sigma,
        "warnings": list(run.warnings),
        "gravity": None if slam.gravity is None else slam.gravity.tolist(),
        "T_lw": None if (T_lw := slam.T_lw) is None else T_lw.tolist(),
        "failure": run.failure or f"killed or still running after {frames}{total} frames",
        "diagnosis": run.diagnosis,
        "pose_latency": run.live.statistics("pose_latency"),
        "latency": run.live.statistics("latency"),
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
            return int(found[1]) * _KERNEL_KB / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else _KERNEL_KB) / 1e6


def _write_maps(folder: Path, pipeline: Pipeline, trajectory: Trajectory, point_map: PointMap) -> None:
    slam = pipeline.slam
    write_ply(folder / RunFile.MAP, point_map.points, point_map.colours, normals=point_map.normals)
    if slam.config.dense_map.mesh.enabled:
        mesh = fuse_mesh(pipeline.views.connected(), slam.config.dense_map)
        write_ply(folder / RunFile.MESH, mesh.vertices, mesh.colours, normals=mesh.normals, faces=mesh.faces)
    if slam.occupancy is not None:
        _write_occupancy(folder, slam.occupancy)
    keyframes = slam.map.active_keyframes
    stamps = torch.tensor([keyframe.stamp for keyframe in keyframes], dtype=torch.float64)
    known = torch.tensor([keyframe.is_from_earlier_run for keyframe in keyframes], dtype=torch.bool)
    positions = torch.searchsorted(trajectory.stamps, stamps).masked_fill(known, -1)
    T_wk, camera = invert(stack_poses(keyframes)), pipeline.sequence.camera
    path = make_camera_path(trajectory, slam.poses.statuses, T_wk, positions, camera)
    write_ply(folder / RunFile.CAMERA_PATH, path.points, path.colours, faces=path.faces, edges=path.edges)


def _write_occupancy(folder: Path, mapper: OccupancyMapper) -> None:
    """Write the occupancy map, and its 2D grid if a floor is visible."""
    floor = mapper.find_floor()
    save_occupancy(folder / RunFile.OCCUPANCY, mapper.map, floor)
    write_octomap(folder / RunFile.OCTOMAP, mapper.map)
    if floor is None:
        _LOG.warning("occupancy map: no floor is visible; no 2D grid was written; let the camera see the floor")
    else:
        write_map_server_files(folder / RunFile.GRID, occupancy_grid(mapper.map, floor))
