"""Sequences with real images through the whole system and the real network: every frame has a pose, and a good one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from v3d_torch.datasets.tum_trajectory import read_trajectory

Run = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def run(v3d_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a sequence from the command line and returns its metrics."""

    def run_sequence(name: str, *options: str) -> dict[str, Any]:
        out = tmp_path_factory.mktemp(name)
        arguments = ["--seq", str(v3d_data / name), "--out", str(out), "--set", "threads=1", *options]
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-m", "v3d_torch.run", *arguments], capture_output=True, text=True, env=os.environ
        )
        assert done.returncode == 0, done.stderr
        metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())
        associated = (v3d_data / name / "associations.txt").read_text().splitlines()
        assert len(read_trajectory(out / "trajectory.txt")) == metrics["frames"] == len(associated)
        assert metrics["coverage"] == 1.0
        return metrics

    return run_sequence


def test_a_camera_that_stands_among_walkers(run: Run) -> None:
    metrics = run("crowd_static")
    assert metrics["frames"] == 108
    assert metrics["ate"]["rmse"] < 0.01
    assert metrics["lost"] + metrics["disconnected"] == 0


def test_a_camera_that_turns_among_walkers_needs_to_know_who_moves(run: Run) -> None:
    metrics, without = run("crowd_rpy"), run("crowd_rpy", "--segmenter", "none")
    assert metrics["frames"] == 180
    assert metrics["ate"]["rmse"] < 0.03
    assert abs(metrics["readout"]) < 0.002  # a rendered camera has no rolling shutter
    assert metrics["ate"]["rmse"] < 0.6 * without["ate"]["rmse"]
    assert metrics["lost"] + metrics["disconnected"] == 0


def test_fast_turns_before_a_desk(run: Run) -> None:
    """TUM's fr1_rpy: real noise, real blur, a strong lens."""
    metrics = run("fr1_rpy")
    assert metrics["frames"] == 694
    assert metrics["ate"]["rmse"] < 0.015  # ORB-SLAM2 and 3, which know no rolling shutter: 0.021
    assert 0.018 < metrics["readout"] < 0.032
