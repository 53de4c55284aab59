"""The same input gives the same bytes in every run, with and without prefetching, with one thread or two."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.first_frames import FirstFrames
from helpers.library_settings import torch_threads

from v3d_torch import V3DSLAM, load_sequence
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.pipeline import Pipeline

FRAMES = 12
RUNS = {
    "by default": (),
    "without prefetching, two threads": ("prefetch=false", "threads=2", "segmentation.threads=2"),
}


def trajectory(sequence: RGBDSequence, overrides: tuple[str, ...], path: Path) -> bytes:
    config = load_config(None, overrides)
    with torch_threads(config.threads):
        pipeline = Pipeline(FirstFrames(sequence, FRAMES), V3DSLAM(sequence.camera, config=config))
        assert pipeline().failure is None
    write_trajectory(path, pipeline.slam.poses.trajectory())
    return path.read_bytes()


@pytest.mark.parametrize("name", ["demo", "walkers_desk", "crowd_rpy"])
def test_trajectory_is_identical_in_every_run(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """With the network. The camera of walkers_desk rolls, so its images are rotated by the predicted pose."""
    sequence = load_sequence(name if name == "demo" else str(request.getfixturevalue("real_sequence")(name)))
    trajectories = {
        run: trajectory(sequence, overrides, tmp_path / "trajectory.txt") for run, overrides in RUNS.items()
    }
    assert len(trajectories["by default"].splitlines()) == FRAMES
    assert {run for run, content in trajectories.items() if content != trajectories["by default"]} == set()
