"""The results of a run as files: the contract that other tools read (README, "Results")."""

from __future__ import annotations

import json
import platform
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import numpy as np
import plyfile
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from v3d_torch.config_file import dump_config
from v3d_torch.errors import InputError
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.files import write_text, written_whole
from v3d_torch.lie import invert
from v3d_torch.mapping.recorder import Status
from v3d_torch.pipeline import Pipeline
from v3d_torch.segmentation.coco import class_name
from v3d_torch.trajectory import write_trajectory
from v3d_torch.types import Trajectory
from v3d_torch.viz.figures import mask_strip, trajectory_figure

if sys.platform != "win32":
    import resource

_LIBRARIES = ("torch", "kornia", "kornia-rs", "numpy", "onnxruntime", "opencv-python-headless", "pypose", "faiss-cpu")

_DYNAMICS = pa.schema(
    [
        ("frame", pa.int64()),
        ("stamp", pa.float64()),
        ("id", pa.int64()),
        ("class", pa.string()),
        ("x", pa.float64()),
        ("y", pa.float64()),
        ("z", pa.float64()),
        ("votes", pa.int64()),
        ("chamfer", pa.float64()),
        ("verdict", pa.string()),
        ("missed", pa.bool_()),
    ]
)


def write_results(folder: Path, pipeline: Pipeline) -> Evaluation | None:
    """Write everything that a run leaves behind.

    Args:
        folder: of this run; made when it is not there.
        pipeline: that has run, to the end or not.

    Returns:
        The scores where there is ground truth.

    Raises:
        OutputError: when the folder cannot be written or the disk is full.
    """
    slam, sequence = pipeline.slam, pipeline.sequence
    trajectory = slam.poses.trajectory()
    write_trajectory(folder / "trajectory.txt", trajectory)  # first: the disk may have room for this and no more
    write_text(folder / "config.yaml", dump_config(slam.config))
    keyframes = slam.mapper.map.keyframes
    stamps = torch.tensor([keyframe.stamp for keyframe in keyframes], dtype=torch.float64)
    write_trajectory(folder / "keyframes.txt", Trajectory(stamps, invert(slam.mapper.map.T_cw)))
    evaluation = None
    if sequence.groundtruth is not None:
        with suppress(InputError):  # too few poses to score are still worth writing
            evaluation = evaluate(sequence.groundtruth, trajectory, frames=pipeline.frames)
    write_text(folder / "metrics.json", json.dumps(_metrics(pipeline, evaluation), indent=2) + "\n")
    with written_whole(folder / "dynamics.parquet") as path:
        pq.write_table(pa.Table.from_pylist(pipeline.run.dynamics, schema=_DYNAMICS), path)
    _write_ply(folder / "map.ply", *pipeline.dense.fuse())
    _draw(folder / "figures", pipeline, trajectory)
    return evaluation


def _metrics(pipeline: Pipeline, evaluation: Evaluation | None) -> dict[str, object]:
    slam, run = pipeline.slam, pipeline.run
    statuses = slam.poses.statuses
    frames = len(statuses)
    counts = {status.value: statuses.count(status) for status in Status}
    masks = run.mask_evaluation.scores()
    return {
        **(evaluation.to_dict() if evaluation is not None else {"ate": None, "rpe": None}),
        "masks": masks.to_dict() if masks is not None else None,
        "sequence": pipeline.sequence.name,
        "frames": pipeline.frames,
        "processed": frames,
        **counts,
        "status": [status.value for status in statuses],
        "keyframes": len(slam.mapper.map.keyframes),
        "landmarks": int(slam.mapper.map.landmarks["alive"].sum()),
        "loops": slam.loops.count,
        "failure": run.failure,
        "fps": frames / run.seconds if run.seconds else None,
        "seconds": run.seconds,
        "seconds_per_stage": dict(slam.clock.seconds),
        "peak_memory_mb": _peak_memory_mb(),
        "seed": slam.config.seed,
        "versions": {
            "v3d-torch": version("v3d-torch"),
            "python": platform.python_version(),
            **{name: version(name) for name in _LIBRARIES},
        },
        "machine": {"processor": platform.machine(), "system": platform.system(), "threads": slam.config.threads},
    }


def _peak_memory_mb() -> float | None:
    if sys.platform == "win32":
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def _write_ply(path: Path, points: Tensor, colours: Tensor) -> None:
    vertices = np.empty(
        len(points), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    )
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = points[:, column].numpy()
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, column].numpy()
    with written_whole(path) as temporary:
        plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(temporary)


def _draw(folder: Path, pipeline: Pipeline, trajectory: Trajectory) -> None:
    groundtruth = pipeline.sequence.groundtruth
    trajectory_figure(groundtruth, trajectory, folder / "trajectory.png", title=pipeline.sequence.name)
    snapshots = pipeline.run.snapshots
    if snapshots:
        overlays = [
            [(judged.mask, f"{class_name(judged.label)} {judged.id}", judged.verdict.value) for judged in shot.objects]
            for shot in snapshots
        ]
        mask_strip([shot.image for shot in snapshots], overlays, folder / "masks.png")
