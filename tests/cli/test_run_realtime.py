"""The run command with --realtime: a stored sequence is played at its own rate."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers.commands import assert_error_line, command
from typer.testing import CliRunner, Result

from v3d_torch.cli import run
from v3d_torch.datasets.demo.sequence import FRAME_RATE, write_sequence
from v3d_torch.datasets.tum_trajectory import read_trajectory

FRAMES = 24


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sequences") / "second"
    write_sequence(folder, range(45, 45 + FRAMES))
    return folder


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(run.app, command(*arguments)[3:], env={"COLUMNS": "120", "NO_COLOR": "1"})


def test_run_reports_latency_dropped_frames_and_accuracy(sequence: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = call("--seq", sequence, "--segmenter", "none", "--realtime", "--out", out)
    assert done.exit_code == 0, done.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["failure"] is None
    assert metrics["processed"] + metrics["dropped"] == metrics["frames"]
    assert metrics["processed"] >= 1 and metrics["frames"] <= FRAMES and metrics["rejected"] == 0
    assert metrics["seconds"] >= (metrics["frames"] - 1) / FRAME_RATE
    assert 0 < metrics["latency"]["median"] <= metrics["latency"]["p95"] <= metrics["latency"]["max"]
    text = done.stdout
    assert f"median {1e3 * metrics['latency']['median']:.0f} ms" in text
    assert f"{metrics['dropped']} of {metrics['frames']} frames" in text

    states = pd.read_parquet(out / "states.parquet")
    trajectory = read_trajectory(out / "trajectory.txt")
    assert len(states) == len(trajectory) == metrics["processed"]
    assert np.allclose(states["stamp"], trajectory.stamps)
    assert states["dropped"].sum() == metrics["dropped"]
    assert states["latency"].max() == pytest.approx(metrics["latency"]["max"])
    covariances = np.stack(states["covariance"].to_list()).reshape(-1, 6, 6)
    assert np.allclose(covariances, covariances.transpose(0, 2, 1))


def test_stored_run_has_states_without_latency(sequence: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call("--seq", sequence, "--segmenter", "none", "--out", out).exit_code == 0
    states = pd.read_parquet(out / "states.parquet")
    assert len(states) == FRAMES and states["latency"].isna().all() and states["dropped"].isna().all()
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["latency"], metrics["dropped"], metrics["gravity"]) == (None, 0, None)
    quaternions = states[["qx", "qy", "qz", "qw"]].to_numpy()
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--serial", "prefetch=false: a live camera needs threads; remove --serial"),
        ("--skip-broken", "--realtime: a broken frame ends the playback; remove --skip-broken"),
    ],
)
def test_options_that_exclude_each_other_are_an_error(sequence: Path, tmp_path: Path, option: str, words: str) -> None:
    done = call("--seq", sequence, "--segmenter", "none", "--realtime", option, "--out", tmp_path / "out")
    assert_error_line(done, words)
