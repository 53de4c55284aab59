"""A run that writes its files."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.wall_run import FRAMES, Wall, square

from v3d_torch.config import Config
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.pipeline import pipeline as pipeline_module
from v3d_torch.runs.metrics_file import read_metrics
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.run import Run


def test_poses_and_sparse_map_are_written_before_the_point_map_is_fused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without an autosave before, as in a short run."""

    def fuse_points(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(pipeline_module, "fuse_points", fuse_points)
    run = Run(RunRequest("wall", Config(), save_map=str(tmp_path / "room.npz")), Wall(), square, tmp_path)
    with pytest.raises(MemoryError):
        run(lambda *_: None)
    assert len(read_trajectory(tmp_path / "trajectory.txt")) == FRAMES
    assert {"states.parquet", "dynamics.parquet", "room.npz"} <= {path.name for path in tmp_path.iterdir()}
    failure = read_metrics(tmp_path / "metrics.json").failure
    assert failure == f"killed or still running after {FRAMES} of {FRAMES} frames"
