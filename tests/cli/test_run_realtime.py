"""The run command with --realtime: a stored sequence is played at its own rate."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers.commands import assert_error_line, command, invoke
from helpers.demo_frames import copy_frames
from helpers.forked_command import start_forked
from helpers.long_wall import Slide
from helpers.tum_folder_with_person import write_walker
from helpers.waiting import wait_until
from typer.testing import Result

from v3d_torch.cli import run
from v3d_torch.datasets.demo.sequence import FRAME_RATE
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.io.files import write_png

pytestmark = pytest.mark.usefixtures("no_figures")

FRAMES = 24


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sequences") / "second"
    copy_frames(folder, range(45, 45 + FRAMES))
    return folder


def call(*arguments: str | Path) -> Result:
    return invoke(run.app, *command(*arguments)[3:], COLUMNS="120", NO_COLOR="1")


def test_run_reports_latency_dropped_frames_and_accuracy(sequence: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = call("--seq", sequence, "--segmenter", "none", "--realtime", "--out", out)
    assert done.exit_code == 0, done.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["failure"] is None
    assert metrics["processed"] + metrics["dropped"] == metrics["frames"]
    assert metrics["processed"] >= 1 and metrics["frames"] <= FRAMES and metrics["rejected"] == 0
    assert metrics["seconds"] >= (metrics["frames"] - 1) / FRAME_RATE
    text = done.stdout
    for title, name in (("latency of poses", "pose_latency"), ("latency of results", "latency")):
        latency = metrics[name]
        assert 0 < latency["median"] <= latency["p95"] <= latency["max"]
        (row,) = [line for line in text.splitlines() if title in line]
        assert f"median {1e3 * latency['median']:.0f} ms, 95% below {1e3 * latency['p95']:.0f} ms" in row
    assert metrics["pose_latency"]["median"] <= metrics["latency"]["median"]
    assert f"{metrics['dropped']} of {metrics['frames']} frames" in text

    states = pd.read_parquet(out / "states.parquet")
    trajectory = read_trajectory(out / "trajectory.txt")
    assert len(states) == len(trajectory) == metrics["processed"]
    assert np.allclose(states["stamp"], trajectory.stamps)
    assert states["dropped"].sum() == metrics["dropped"]
    for name in ("pose_latency", "latency"):
        assert states[name].max() == pytest.approx(metrics[name]["max"])
    covariances = np.stack(states["covariance"].to_list()).reshape(-1, 6, 6)
    assert np.allclose(covariances, covariances.transpose(0, 2, 1))


def test_what_is_known_of_the_stored_sequence_is_reported(moment: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "rgbd_dataset_freiburg3_walking_xyz", tmp_path / "out"
    shutil.copytree(moment, folder)
    (folder / "groundtruth.txt").write_text("1 2 3\n")
    done = call("--seq", folder, "--segmenter", "none", "--realtime", "--out", out)
    error = f"{folder / 'groundtruth.txt'}: line 1 is '1 2 3'"
    assert_error_line(done, error)
    assert f"note: fr3/w/xyz: the ground truth cannot be read: {error}" in done.stdout
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["difference"] == "another recording: 6 frames, not 827"
    assert error in metrics["diagnosis"] and any(error in warning for warning in metrics["warnings"])


def test_masks_from_files_need_no_network(tmp_path: Path) -> None:
    folder, out = write_walker(tmp_path / "walker", 8), tmp_path / "out"
    masks = ["--segmenter", "masks", "--masks", folder / "ids"]
    done = call("--seq", folder, *masks, "--realtime", "--config", "realtime", "--out", out)
    assert done.exit_code == 0, done.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["failure"] is None and metrics["processed"] >= 1
    assert pd.read_parquet(out / "objects.parquet")["class"].tolist()


def test_live_run_cannot_be_resumed(moment: Path, tmp_path: Path) -> None:
    """Its whole run counted as finished, although it ended when Ctrl-C was pressed."""
    out = tmp_path / "out"
    assert call("--seq", moment, "--segmenter", "none", "--realtime", "--out", out).exit_code == 0
    assert_error_line(call("--resume", out), f"{out}: a live run cannot be resumed; its results are in this folder\n")


def test_run_that_ends_before_its_first_frame_leaves_no_empty_folder(
    moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as by SIGTERM while the functions are compiled."""

    def interrupt(console: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("v3d_torch.runs.console.compile_with_progress", interrupt)
    (tmp_path / "own").mkdir()
    for options in (["--out", "out"], [], ["--out", "own"]):
        done = call("--seq", moment, "--segmenter", "none", "--realtime", *options)
        assert_error_line(done, "interrupted before the results were written\n")
    assert not (tmp_path / "out").exists() and (tmp_path / "own").exists()
    (named,) = (tmp_path / "results").iterdir()
    assert list(named.iterdir()) == []


def test_stored_run_has_states_without_latency(moment: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call("--seq", moment, "--segmenter", "none", "--out", out).exit_code == 0
    states = pd.read_parquet(out / "states.parquet")
    assert len(states) == 6 and states[["pose_latency", "latency", "dropped"]].isna().all(axis=None)
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["pose_latency"], metrics["latency"], metrics["dropped"], metrics["gravity"]) == (
        None,
        None,
        0,
        None,
    )
    quaternions = states[["qx", "qy", "qz", "qw"]].to_numpy()
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)


@pytest.mark.skipif(os.name == "nt", reason="no SIGSTOP")
def test_camera_is_tracked_again_within_a_second_after_the_process_was_stopped_for_one(tmp_path: Path) -> None:
    """As by a scheduler or a suspended computer; the camera moves on meanwhile. A mask is written per tracked frame."""
    slide, folder, out = Slide(0, 320, step=4), tmp_path / "slide", tmp_path / "out"
    with TUMWriter(folder, slide.camera, slide.groundtruth) as writer:
        for index in range(len(slide)):
            writer.add(slide[index])
    options = ["--seq", folder, "--segmenter", "none", "--realtime", "--save-masks", "--out", out]
    process = start_forked(*options, cwd=tmp_path)
    assert process.pid is not None
    folder_of_masks = out / "masks"
    wait_until(
        lambda: len(list(folder_of_masks.glob("*.png"))) >= 3 or not process.is_alive(), 300, "three masks were written"
    )
    masks = sorted(folder_of_masks.glob("*.png"))
    assert process.is_alive()
    os.kill(process.pid, signal.SIGSTOP)
    time.sleep(1)
    os.kill(process.pid, signal.SIGCONT)
    process.join(timeout=300)
    assert process.exitcode == 0
    states, metrics = pd.read_parquet(out / "states.parquet"), json.loads((out / "metrics.json").read_text())
    assert metrics["failure"] is None and metrics["processed"] + metrics["dropped"] == metrics["frames"] == len(slide)
    later = states[states["stamp"] > float(masks[-1].stem) + 2]
    assert len(later) and set(later["status"]) == {"tracked"}


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


def test_masks_are_checked_as_for_a_stored_run(tmp_path: Path) -> None:
    """Each frame got the mask of the frame with half its number."""
    folder = write_walker(tmp_path / "walker", 8)
    images = sorted((folder / "ids").iterdir())
    for number, image in enumerate([*images, *images]):
        (tmp_path / "ids").mkdir(exist_ok=True)
        shutil.copy(image, tmp_path / "ids" / f"{number:04}.png")
    for options in ([], ["--realtime"]):
        done = call("--seq", folder, "--segmenter", "masks", "--masks", tmp_path / "ids", *options)
        assert_error_line(
            done, f"{tmp_path / 'ids'}: has 16 id images for 8 frames, and their names are not timestamps"
        )


def test_cause_of_a_lost_camera_is_found_in_the_images(moment: Path, tmp_path: Path) -> None:
    without_depth = tmp_path / "empty"
    shutil.copytree(moment, without_depth)
    for path in (without_depth / "depth").iterdir():
        write_png(path, np.zeros((480, 640), np.uint16))
    done = call("--seq", without_depth, "--segmenter", "none", "--realtime", "--out", tmp_path / "out")
    assert_error_line(done, "empty: the camera was not found in any of the ")
    assert "frames, the depth images are empty; record or export them again" in " ".join(done.stderr.split())
