"""Recorded images through the whole system with the network: every frame has an accurate pose."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import call_here

from v3d_torch.datasets.tum_trajectory import read_trajectory

pytestmark = pytest.mark.usefixtures("no_figures")

Run = Callable[..., dict[str, Any]]


def select_frames(sequence: Path, folder: Path, frames: range) -> Path:
    """Make a folder with some frames of a sequence, whose images stay where they are."""
    folder.mkdir()
    for name in ("rgb", "depth", "groundtruth.txt", "camera.yaml"):
        (folder / name).symlink_to(sequence / name)
    rows = (sequence / "associations.txt").read_text().splitlines(keepends=True)
    (folder / "associations.txt").write_text("".join(rows[index] for index in frames))
    return folder


@pytest.fixture(scope="module")
def run(real_sequence: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Function that runs frames of a sequence with the command, in this process, and returns its metrics."""

    def run_sequence(name: str, *options: str, frames: range) -> dict[str, Any]:
        out = tmp_path_factory.mktemp(name)
        folder = select_frames(real_sequence(name), tmp_path_factory.mktemp("some") / name, frames)
        done = call_here("--seq", folder, "--out", out, *options, cwd=out)
        assert done.exit_code == 0, done.stderr
        metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())
        associated = (folder / "associations.txt").read_text().splitlines()
        assert len(read_trajectory(out / "trajectory.txt")) == metrics["frames"] == len(associated)
        assert metrics["coverage"] == 1.0
        assert metrics["warnings"] == []  # the camera files are right, and so is the exposure
        return metrics

    return run_sequence


def test_static_camera_among_walkers_is_tracked_accurately(run: Run) -> None:
    metrics = run("crowd_static", frames=range(24))
    assert metrics["frames"] == 24
    assert metrics["ate"]["rmse"] < 0.005
    assert metrics["lost"] + metrics["disconnected"] == 0


def test_rotating_camera_among_walkers_is_more_accurate_with_masks(run: Run) -> None:
    """At 15 Hz."""
    frames = range(80, 180, 2)
    metrics, unmasked = run("crowd_rpy", frames=frames), run("crowd_rpy", "--segmenter", "none", frames=frames)
    assert metrics["frames"] == 50
    assert metrics["ate"]["rmse"] < 0.03
    assert abs(metrics["readout"]) < 0.002  # a rendered camera has no rolling shutter
    assert metrics["ate"]["rmse"] < 0.6 * unmasked["ate"]["rmse"]
    assert metrics["lost"] + metrics["disconnected"] == 0


def test_fast_rotation_is_tracked_and_its_readout_calibrated(run: Run) -> None:
    """The first four seconds of TUM fr1_rpy at 15 Hz: sensor noise, motion blur, strong lens distortion."""
    metrics = run("fr1_rpy", frames=range(0, 120, 2))
    assert metrics["frames"] == 60
    assert metrics["ate"]["rmse"] < 0.015  # better than ORB-SLAM2 and 3, which do not model the rolling shutter
    assert 0.018 < metrics["readout"] < 0.032
