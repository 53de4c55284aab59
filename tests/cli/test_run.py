"""``python -m v3d_torch.run`` as a user calls it: results, error messages, Ctrl-C, the built-in demo."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import plyfile
import pytest
import typer.main
from helpers.bag_messages import read_with_mcap
from helpers.batches import ENDLESS, repeat_sequence
from helpers.commands import RUN_FILES, assert_error_line, call, call_here, command, environment, files_in, invoke
from helpers.corpus.outputs import at_frame
from helpers.demo_frames import copy_frames
from helpers.forked_command import call_forked, start_forked
from helpers.waiting import wait_until
from typer.testing import Result

from v3d_torch.cli import report, run
from v3d_torch.datasets.demo.scenes.walking import WALK_SPEED, WALK_START
from v3d_torch.datasets.demo.sequence import FRAME_COUNT, FRAME_RATE
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.runs.result_folder import clear_earlier_results, lock_results

OBJECT_FILES = {"figures/voting.png", "figures/clusters.png", "figures/objects.png"}
"""Files that are written if objects were detected and voted on."""

WALKER_START_X, WALKER_Y = -1.75, 2.0
STANDER = (-0.91, 3.05)
SWAYER = (1.02, 2.98)
"""Positions of the demo's people on the floor, metres right and away (datasets/demo/scenes/walking.py)."""


@pytest.fixture(scope="session")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second of the demo in TUM layout, in which the walker crosses the room."""
    folder = tmp_path_factory.mktemp("sequences") / "second"
    copy_frames(folder, range(45, 75))
    return folder


@pytest.fixture(scope="session")
def first_run(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """Results of that second with its own masks, and the output of the command."""
    out = tmp_path_factory.mktemp("first") / "out [b]"
    done = call_here(*with_masks(sequence), "--out", out, "--save-masks", "--profile", cwd=out.parent)
    assert done.exit_code == 0, done.stderr
    return out, done


@pytest.fixture(scope="session")
def first_out(first_run: tuple[Path, Result]) -> Path:
    return first_run[0]


def with_masks(sequence: Path) -> list[str | Path]:
    return ["--seq", sequence, "--segmenter", "masks", "--masks", sequence / "masks"]


@pytest.fixture
def copy(sequence: Path, tmp_path: Path) -> Path:
    """Copy of the sequence that a test can damage. The images are hard links: replace them, do not write to them."""
    folder = tmp_path / "copy"
    shutil.copytree(sequence, folder, copy_function=os.link)
    return folder


def rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    content = change(path.read_bytes())
    path.unlink()
    path.write_bytes(content)


# --- results


def test_run_writes_all_files(first_out: Path, sequence: Path) -> None:
    assert {
        name for name in files_in(first_out) if not name.startswith(("masks/", "map_masks/"))
    } == RUN_FILES | OBJECT_FILES
    trajectory = read_trajectory(first_out / "trajectory.txt")
    listed = [float(line.split()[0]) for line in (sequence / "associations.txt").read_text().splitlines()]
    assert trajectory.stamps.tolist() == listed
    metrics = json.loads((first_out / "metrics.json").read_text())
    assert metrics["ate"]["rmse"] < 0.005
    assert metrics["tracked"] == metrics["frames"] == 30
    assert metrics["readout"] == metrics["readout_sigma"] == 0.0  # as the camera file of the demo states
    log = (first_out / "run.log").read_text().splitlines()
    assert any(line.endswith("readout: 0.0000 s, as the camera states") for line in log)
    assert sum("frame" in line and "tracked" in line for line in log) == 30


def test_every_file_of_a_run_is_removed_before_the_next_one(tmp_path: Path) -> None:
    """A file that is not in the list of results would stay, and the report would show it."""
    part, out = tmp_path / "part", tmp_path / "out"
    copy_frames(part, range(45, 57))
    done = call_here(*with_masks(part), "--save-masks", "--mesh", "--occupancy", "--out", out, cwd=tmp_path)
    assert (done.exit_code, done.stderr) == (0, "")
    assert invoke(report.app, out).exit_code == 0
    written = files_in(out)
    assert written >= RUN_FILES | OBJECT_FILES | {"mesh.ply", "occupancy.npz", "figures/occupancy.png", "report.html"}
    assert any(name.startswith("masks/") for name in written)
    clear_earlier_results(out)
    assert [path.name for path in out.iterdir()] == ["run.log"]


def test_folder_to_which_another_run_writes_is_an_error_and_stays(sequence: Path, tmp_path: Path) -> None:
    """No recording is created either: the same command would be refused once more when the other run has ended."""
    with lock_results(tmp_path / "out"):
        for name in ("run.log", "metrics.json"):
            (tmp_path / "out" / name).write_text("of the other run")
        arguments = ("--seq", sequence, "--segmenter", "none", "--out", "out", "--rerun", "run.rrd")
        done = call_here(*arguments, cwd=tmp_path)
        assert_error_line(done, "out: another run or batch is writing to this folder")
        assert not (tmp_path / "run.rrd").exists()
        assert {(tmp_path / "out" / name).read_text() for name in ("run.log", "metrics.json")} == {"of the other run"}


@pytest.mark.skipif(os.name == "nt", reason="Windows does not remove open files")
def test_result_folder_that_is_removed_during_the_run_is_complete_and_usable(moment: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = (*with_masks(moment), "--out", out, "--serial")
    with at_frame(4, lambda: shutil.rmtree(out)):
        done = call_here(*arguments, cwd=tmp_path)
    warning = f"{out}: was removed during the run; what was written before is lost, such as log and masks"
    assert done.exit_code == 0 and done.stdout.count(f"warning: {warning}\n") == 1, done.stderr
    assert json.loads((out / "metrics.json").read_text())["warnings"] == [warning]
    assert files_in(out) >= RUN_FILES and warning in (out / "run.log").read_text()
    done = call_here(*arguments, cwd=tmp_path)
    assert done.exit_code == 0 and warning not in done.stdout, done.stderr


def test_bag_is_recorded_and_results_are_the_same(first_out: Path, sequence: Path, tmp_path: Path) -> None:
    arguments = (*with_masks(sequence), "--bag", "run.mcap")
    done = call_here(*arguments, "--out", "out", "--save-masks", cwd=tmp_path)
    assert (done.exit_code, done.stderr) == (0, "")
    messages = read_with_mcap(tmp_path / "run.mcap")
    assert len(messages["/odom"]) == 30 and len(messages["/path"][-1][1].poses) == 30
    same = [name for name in files_in(first_out) if not name.endswith(("run.log", "metrics.json", "frames.parquet"))]
    assert len(same) > 35
    assert [name for name in same if (tmp_path / "out" / name).read_bytes() != (first_out / name).read_bytes()] == []
    done = call_here(*arguments, "--out", "again", "--rerun", "run.rrd", cwd=tmp_path)
    assert_error_line(done, "run.mcap: already exists; delete it, or choose another file")
    assert not (tmp_path / "again").exists() and not (tmp_path / "run.rrd").exists()


def test_run_prints_scores_and_result_folder(
    first_run: tuple[Path, Result],
) -> None:
    out, done = first_run
    assert done.stderr == ""
    objects = pd.read_parquet(out / "objects.parquet")
    summary = done.stdout.partition("time per frame")[0].splitlines()
    shown = {row[1].strip(): row[2].strip() for line in summary if len(row := line.split("│")) > 3}
    assert shown["objects"] == str(objects["id"].nunique())
    counts = objects["motion_state"].value_counts()
    assert set(shown["frames of objects"].split(", ")) == {f"{count} {state}" for state, count in counts.items()}
    for words in ("ATE rmse", "(coverage 100.0%)", "30 of 30", "30 tracked", f"results: {out}"):
        assert words in done.stdout


def test_profile_prints_the_time_of_each_stage(first_run: tuple[Path, Result]) -> None:
    out, done = first_run
    frames = 1e3 * pd.read_parquet(out / "frames.parquet").filter(like="seconds_")
    wall, cpu = frames.filter(regex="^seconds_"), frames.filter(regex="^cpu_seconds_")
    stages = wall.columns.str.removeprefix("seconds_")
    rows = [line.strip("│ ").split() for line in done.stdout.partition("time per frame, ms")[2].splitlines()]
    shown = {" ".join(row[:-10]): row[-9::2] for row in rows if len(row) > 10 and row[-1].endswith("%")}
    features, back_end = stages.isin(["read", "depth", "features"]), stages.isin(["bundle", "loop"])
    segmentation = stages == "segmentation"
    expected = {stage: stages == stage for stage in stages}
    expected |= {"chain: features": features, "chain: segmentation": segmentation, "chain: back end": back_end}
    expected |= {"chain: tracking": ~features & ~segmentation & ~back_end}
    expected |= {"all": np.ones(len(stages), np.bool_)}
    assert list(shown) == list(expected)
    for name, members in expected.items():
        taken, used = wall.loc[:, members].sum(axis=1), cpu.loc[:, members].sum(axis=1)
        figures = [taken.mean(), np.median(taken), np.quantile(taken, 0.95), used.mean()]
        assert list(map(float, shown[name][:4])) == pytest.approx(figures, abs=0.06)  # printed with one decimal
        assert float(shown[name][4].rstrip("%")) == pytest.approx(100 * used.sum() / cpu.to_numpy().sum(), abs=0.6)
    frame_rate = 1e3 / json.loads((out / "metrics.json").read_text())["fps"]
    assert f"{frame_rate:.1f} ms of wall time per frame" in " ".join(done.stdout.split())


def test_saved_masks_are_binary_and_named_by_timestamp(first_out: Path, sequence: Path) -> None:
    stamps = [line.split()[0] for line in (sequence / "associations.txt").read_text().splitlines()]
    assert sorted(path.name for path in (first_out / "masks").iterdir()) == [
        f"{float(stamp):.6f}.png" for stamp in stamps
    ]
    for stamp in stamps:
        saved = cv2.imread(str(first_out / "masks" / f"{float(stamp):.6f}.png"), cv2.IMREAD_UNCHANGED)
        truth = cv2.imread(str(sequence / "masks" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
        assert saved.dtype == np.uint8 and saved.shape == (480, 640)
        assert set(np.unique(saved)) <= {0, 255}
        assert (saved[truth > 0] == 255).mean() > 0.95  # people who move, or could move, are masked
        assert (saved == 255).mean() < 0.6


def test_results_are_the_same_bytes_with_two_threads(first_out: Path, sequence: Path, tmp_path: Path) -> None:
    """The first run had one thread. This run has two, in another process."""
    done = call_forked(*with_masks(sequence), "--out", tmp_path, "--set", "threads=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for name in ("trajectory.txt", "keyframes.txt", "objects.parquet", "map.ply"):
        assert (tmp_path / name).read_bytes() == (first_out / name).read_bytes(), name


def test_run_without_segmenter_and_out_writes_a_folder_by_time(moment: Path, tmp_path: Path) -> None:
    """The link ``latest`` points to the newest results. Without masks there are no objects."""
    runs = tmp_path / "results" / "moment"
    newest = []
    for seed in (3, 4):
        done = call_here("--seq", moment, "--segmenter", "none", "--seed", str(seed), cwd=tmp_path)
        assert done.exit_code == 0, done.stderr
        latest = runs / "latest"
        assert latest.is_symlink()
        assert files_in(latest.resolve()) == RUN_FILES
        assert json.loads((latest / "metrics.json").read_text())["seed"] == seed
        assert len(pd.read_parquet(latest / "objects.parquet")) == 0
        newest.append(latest.resolve())
    assert newest[0] != newest[1]
    assert {path.name for path in runs.iterdir()} == {"latest", *(path.name for path in newest)}


@pytest.mark.usefixtures("undrawn")
def test_command_line_overrides_the_configuration_file(moment: Path, tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text("mapping: {max_keyframe_interval: 4, min_tracked: 90}\n")
    arguments = (
        "--config",
        tmp_path / "own.yaml",
        "--set",
        "mapping.max_keyframe_interval=7",
        "--set",
        "features.count=900",
    )
    done = call_here("--seq", moment, "--segmenter", "none", *arguments, "--out", tmp_path / "out", cwd=tmp_path)
    assert done.exit_code == 0, done.stderr
    written = (tmp_path / "out" / "config.yaml").read_text()
    for line in ("max_keyframe_interval: 7", "min_tracked: 90", "count: 900", "source: none"):
        assert line in written


def in_millimetres(sequence: Path, folder: Path) -> Path:
    """Copy a sequence with depth in millimetres, which its values tell, and without a depth scale; return the copy."""
    shutil.copytree(sequence, folder)
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) // 5)
    lines = (folder / "camera.yaml").read_text().splitlines(keepends=True)
    (folder / "camera.yaml").write_text("".join(line for line in lines if not line.startswith("depth_scale")))
    return folder


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")
@pytest.mark.usefixtures("undrawn")
def test_estimated_depth_scale_is_recorded_and_shown_once_also_by_a_resumed_run(moment: Path, tmp_path: Path) -> None:
    folder = in_millimetres(moment, tmp_path / "seq")
    arguments = ("--seq", folder, "--segmenter", "none", "--serial", "--out", tmp_path / "out")
    with at_frame(1, lambda: os.kill(os.getpid(), signal.SIGINT)):
        interrupted = call_here(*arguments, cwd=tmp_path)
    resumed = call_here("--resume", tmp_path / "out", cwd=tmp_path)
    assert resumed.exit_code == 0, resumed.stderr
    warnings = json.loads((tmp_path / "out" / "metrics.json").read_text())["warnings"]
    (warning,) = [each for each in warnings if "depth_scale" in each]
    assert [done.stdout.count(f"warning: {warning}\n") for done in (interrupted, resumed)] == [1, 1]


# --- mistakes of the user


def test_unknown_key_is_rejected_with_the_nearest_key(sequence: Path, tmp_path: Path) -> None:
    done = call_here("--seq", sequence, "--set", "objects.voting.vote_treshold=3", cwd=tmp_path)
    assert_error_line(done, "objects.voting.vote_treshold", "objects.voting.vote_threshold")
    assert list(tmp_path.iterdir()) == []


def test_model_without_network_is_rejected(sequence: Path, tmp_path: Path) -> None:
    options = "--seq", sequence, "--segmenter", "none", "--model", "yolo11n-seg", "--out", tmp_path / "out"
    assert_error_line(call_here(*options, cwd=tmp_path), "--model yolo11n-seg: not used with segmentation.source=none")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--seed", "3", "--set", "seed=4"), "--seed 3: conflicts with --set seed=4; remove one of them"),
        (
            ("--occupancy", "--set", "occupancy.enabled=false"),
            "--occupancy: conflicts with --set occupancy.enabled=fal",
        ),
        (("--config", ""), "'': is neither the name of a configuration"),
        (("--serial", "--set", " prefetch = true"), "--serial: conflicts with --set  prefetch = true; remove one of t"),
        (
            ("--masks", "ids", "--set", "segmentation.source=none"),
            "--masks ids: conflicts with --set segmentation.sour",
        ),
    ],
)
def test_options_of_the_configuration_that_conflict_or_are_empty_are_rejected(
    options: tuple[str, ...], message: str, sequence: Path, tmp_path: Path
) -> None:
    assert_error_line(call_here("--seq", sequence, *options, "--out", tmp_path / "out", cwd=tmp_path), message)
    assert not (tmp_path / "out").exists()


def test_unknown_sequence_is_rejected_with_the_nearest_name(tmp_path: Path) -> None:
    assert_error_line(call_here("--seq", "fr3/w/xzy", cwd=tmp_path), "fr3/w/xzy", "fr3/w/xyz")
    assert list(tmp_path.iterdir()) == []


def test_missing_path_is_rejected(tmp_path: Path) -> None:
    assert_error_line(call_here("--seq", tmp_path / "nowhere", cwd=tmp_path), str(tmp_path / "nowhere"))


def test_folder_without_depth_is_rejected(copy: Path, tmp_path: Path) -> None:
    (copy / "associations.txt").unlink()
    (copy / "depth.txt").unlink()
    assert_error_line(call_here("--seq", copy, "--segmenter", "none", cwd=tmp_path), str(copy), "depth.txt")


def test_missing_id_images_are_rejected(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    arguments = ("--seq", sequence, "--segmenter", "masks")
    assert_error_line(call_here(*arguments, "--masks", tmp_path / "empty", cwd=tmp_path), str(tmp_path / "empty"))
    assert_error_line(call_here(*arguments, cwd=tmp_path), "folder of the id images")


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.parametrize("index", [0, 6])
def test_truncated_image_ends_the_run_with_partial_results(kind: str, index: int, copy: Path, tmp_path: Path) -> None:
    damaged = sorted((copy / kind).iterdir())[index]
    rewrite(damaged, lambda content: content[: len(content) // 2])
    done = call_here("--seq", copy, "--segmenter", "none", "--out", tmp_path / "out", cwd=tmp_path)
    assert_error_line(done, str(damaged))
    trajectory = tmp_path / "out" / "trajectory.txt"
    assert len(trajectory.read_text().splitlines() if trajectory.exists() else []) == index
    if index:
        assert files_in(tmp_path / "out") == RUN_FILES | {"checkpoint.v3d"}
        assert str(tmp_path / "out") in done.stderr
        assert json.loads((tmp_path / "out" / "metrics.json").read_text())["processed"] == index


def test_swapped_colour_and_depth_are_rejected(copy: Path, tmp_path: Path) -> None:
    (copy / "associations.txt").unlink()
    colour, depth = (copy / "rgb.txt").read_bytes(), (copy / "depth.txt").read_bytes()
    rewrite(copy / "rgb.txt", lambda _: depth)
    rewrite(copy / "depth.txt", lambda _: colour)
    done = call_here("--seq", copy, "--segmenter", "none", "--out", tmp_path / "out", cwd=tmp_path)
    assert_error_line(done, str(sorted((copy / "depth").iterdir())[0]), "swapped")


def test_8_bit_depth_is_rejected(copy: Path, tmp_path: Path) -> None:
    path = sorted((copy / "depth").iterdir())[0]
    grey = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    rewrite(path, lambda _: cv2.imencode(".png", grey)[1].tobytes())
    done = call_here("--seq", copy, "--segmenter", "none", "--out", tmp_path / "out", cwd=tmp_path)
    assert_error_line(done, str(path), "8-bit", "16 bits")


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("masks/1.0.png", "would be written while it is read"),
        ("map_masks/1.0.png", "would be written while it is read"),
        ("map.ply", "exists and was not written by a run"),
        ("runs.parquet", "out: contains a batch; choose another folder with --out"),
        ("ablation.csv", "out: contains an ablation study; choose another folder with --out"),
    ],
)
def test_unsuitable_result_folder_leaves_no_recording(file: str, words: str, sequence: Path, tmp_path: Path) -> None:
    """The same command with another folder would be refused because of the recording."""
    path = tmp_path / "out" / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")
    masks = ("--segmenter", "masks", "--masks", path.parent) if "masks" in file else ("--segmenter", "none")
    done = call_here("--seq", sequence, *masks, "--out", "out", "--rerun", "run.rrd", cwd=tmp_path)
    assert_error_line(done, words)
    assert not (tmp_path / "run.rrd").exists()


def test_folder_of_the_sequence_is_no_folder_of_results(sequence: Path, tmp_path: Path) -> None:
    before = files_in(sequence)
    (tmp_path / "link").symlink_to(sequence)
    done = call_here("--seq", sequence, "--segmenter", "none", "--out", "link", cwd=tmp_path)
    assert_error_line(done, "link: is the folder of the sequence; choose another folder with --out")
    assert files_in(sequence) == before


@pytest.mark.parametrize(("table", "words"), [("runs.parquet", "a batch"), ("ablation.csv", "an ablation study")])
def test_run_does_not_replace_a_run_of_a_batch(table: str, words: str, sequence: Path, tmp_path: Path) -> None:
    """The tables of the batch would keep the values of the run that is gone, and --resume could accept the new one."""
    (tmp_path / table).write_text("")
    out = tmp_path / "walk" / "full" / "seed0"
    done = call_here("--seq", sequence, "--segmenter", "none", "--out", out, cwd=tmp_path)
    assert_error_line(done, f"{out}: is the folder of a run of {words}; choose another folder with --out")
    assert not out.exists()


@pytest.mark.parametrize("below", [False, True])
def test_result_folder_at_or_below_a_file_is_rejected(below: bool, sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    out = tmp_path / "taken" / "out" if below else tmp_path / "taken"
    done = call_here("--seq", sequence, "--segmenter", "none", "--out", out, cwd=tmp_path)
    assert_error_line(done, str(tmp_path / "taken"))


def test_failed_download_is_reported_and_leaves_no_files(tmp_path: Path) -> None:
    """A proxy address without a server prevents a real download of 500 MB."""
    (tmp_path / "data").mkdir()
    dead_proxies = dict.fromkeys(("https_proxy", "http_proxy", "HTTPS_PROXY", "HTTP_PROXY"), "http://127.0.0.1:9")
    variables = {
        "V3D_DATA": str(tmp_path / "data"),
        "V3D_CACHE": str(tmp_path / "cache"),
        "no_proxy": "",
        **dead_proxies,
    }
    done = call_here("--seq", "fr3/w/xyz", cwd=tmp_path, **variables)
    name = "rgbd_dataset_freiburg3_walking_xyz"
    assert_error_line(done, "fr3/w/xyz", f"{name}.tgz", "https://", str(tmp_path / "data"))
    assert not list((tmp_path / "data").iterdir())


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to another process")
def test_ctrl_c_keeps_partial_results(sequence: Path, tmp_path: Path) -> None:
    endless, out = repeat_sequence(sequence, tmp_path / "endless", ENDLESS), tmp_path / "out"
    (endless / "groundtruth.txt").symlink_to(sequence / "groundtruth.txt")
    process = start_forked(
        *("--seq", endless, "--segmenter", "none", "--save-masks", "--out", out), cwd=tmp_path, output=tmp_path
    )
    wait_until(lambda: len(list((out / "masks").glob("[0-9]*.png"))) >= 3, timeout=100, what="three masks are saved")
    assert process.pid is not None
    os.kill(process.pid, signal.SIGINT)
    process.join(timeout=100)
    assert process.exitcode == 2
    stdout, stderr = ((tmp_path / name).read_text() for name in ("stdout", "stderr"))
    assert_error_line(subprocess.CompletedProcess([], 2, stdout, stderr), "interrupted after")
    assert "results" in stderr
    metrics = json.loads((out / "metrics.json").read_text())
    assert 3 <= metrics["processed"] < ENDLESS
    assert len((out / "trajectory.txt").read_text().splitlines()) == metrics["processed"]
    written = {name for name in files_in(out) if not name.startswith(("masks/", "map_masks/"))}
    # The figure of masks begins after a twelfth of the sequence.
    assert written | {"figures/masks.png"} == RUN_FILES | {"checkpoint.v3d"}


IN_TERMINAL = (
    "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
)
"""Code that makes the standard input the terminal of the process, which then runs a command."""


@pytest.mark.skipif(os.name == "nt", reason="no terminals")
def test_lost_terminal_keeps_partial_results(sequence: Path, tmp_path: Path) -> None:
    """A dropped ssh session ends the run, which can no longer write to the terminal."""
    endless, out = repeat_sequence(sequence, tmp_path / "endless", ENDLESS), tmp_path / "out"
    arguments = command("--seq", endless, "--segmenter", "none", "--out", out)
    master, slave = os.openpty()
    os.set_blocking(master, False)
    process = subprocess.Popen(  # noqa: S603
        [sys.executable, "-c", IN_TERMINAL, *arguments],
        **dict.fromkeys(("stdin", "stdout", "stderr"), slave),
        env=environment(),
        start_new_session=True,
    )
    os.close(slave)

    def is_tracking() -> bool:
        with suppress(BlockingIOError):
            os.read(master, 1 << 16)  # else, a full terminal blocks the run
        assert process.poll() is None
        return (out / "run.log").is_file() and (out / "run.log").read_text().count(" frame ") >= 3

    try:
        wait_until(is_tracking, timeout=100, what="three frames are tracked")
        os.close(master)
        assert process.wait(timeout=100) == 2
    finally:
        process.kill()
        process.wait()
    metrics = json.loads((out / "metrics.json").read_text())
    assert 3 <= metrics["processed"] < ENDLESS and "interrupted after" in metrics["failure"]
    assert len((out / "trajectory.txt").read_text().splitlines()) == metrics["processed"]
    assert (out / "checkpoint.v3d").is_file() and "Traceback" not in (out / "run.log").read_text()


def test_help_names_every_option() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "v3d_torch.run", "--help"], capture_output=True, text=True, env=environment(), check=True
    )
    options = {name for each in typer.main.get_command(run.app).params for name in each.opts}
    assert len(options) >= 30 and "--localise" in options
    assert options <= set(re.findall(r"--[\w-]+", done.stdout)), options


# --- the acceptance test: the built-in demo with the real network


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Results of the whole demo with default options, and the output of the command."""
    out = tmp_path_factory.mktemp("demo")
    done = call("--seq", "demo", "--out", out, cwd=out)
    assert done.returncode == 0, done.stderr
    return out, done.stdout


@pytest.fixture(scope="session")
def people(demo: tuple[Path, str]) -> pd.DataFrame:
    """Rows of all detected people, with centroids in the axes of the room: x right, y away, z up."""
    table = pd.read_parquet(demo[0] / "objects.parquet")
    table = table[(table["class"] == "person") & ~table["missed"] & table["x"].notna()].copy()
    T_ge = np.array(json.loads((demo[0] / "metrics.json").read_text())["alignment"]["T_ge"])
    table[["x", "y", "z"]] = table[["x", "y", "z"]].to_numpy() @ T_ge[:3, :3].T + T_ge[:3, 3]
    return table


def near(people: pd.DataFrame, x: pd.Series | float, y: float, radius: float) -> pd.DataFrame:
    """Rows of people with a centroid near a position on the floor."""
    return people[np.hypot(people["x"] - x, people["y"] - y) < radius]


def test_demo_writes_all_files_and_a_pose_for_each_frame(demo: tuple[Path, str]) -> None:
    out, stdout = demo
    assert files_in(out) == RUN_FILES | OBJECT_FILES
    assert len((out / "trajectory.txt").read_text().splitlines()) == FRAME_COUNT == 120
    assert "ATE rmse" in stdout
    for name in ("figures/trajectory.png", "figures/masks.png", *OBJECT_FILES):
        image = cv2.imread(str(out / name))
        assert image is not None and min(image.shape[:2]) >= 300 and max(image.shape[:2]) <= 4000


def test_demo_trajectory_is_accurate(demo: tuple[Path, str]) -> None:
    metrics = json.loads((demo[0] / "metrics.json").read_text())
    assert metrics["ate"]["rmse"] < 0.02
    assert metrics["rpe"]["trans"]["rmse"] < 0.02 and metrics["rpe"]["rot"]["rmse"] < 0.5
    assert metrics["coverage"] == 1.0 and metrics["lost"] == 0 and metrics["failure"] is None


def test_demo_walker_is_voted_dynamic(people: pd.DataFrame) -> None:
    walker_x = WALKER_START_X + WALK_SPEED * (people["frame"] / FRAME_RATE - WALK_START)
    walker = near(people, walker_x, WALKER_Y, radius=0.3)
    walker = walker[walker["frame"].between(30, 105)]  # in view from head to hip
    assert walker["frame"].nunique() >= 60
    for _, rows in walker.groupby("frame"):
        assert "dynamic" in set(rows["motion_state"])
    assert (walker["votes"] > 0).mean() > 0.5


def test_demo_standing_person_is_static(people: pd.DataFrame) -> None:
    stander = near(people, *STANDER, radius=0.35)
    stander = stander[stander["y"] > WALKER_Y + 0.5]
    assert stander["frame"].nunique() >= 90
    assert (stander["motion_state"] == "static").mean() > 0.6
    assert (stander[stander["frame"] >= 60]["motion_state"] == "static").mean() > 0.85
    assert not stander["motion_state"].isin(["dynamic", "deforming"]).any()


def test_demo_swaying_person_is_deforming(people: pd.DataFrame) -> None:
    swayer = near(people, *SWAYER, radius=0.35)
    swayer = swayer[swayer["y"] > WALKER_Y + 0.5]
    assert swayer["frame"].nunique() >= 90
    alone = swayer[swayer["frame"].between(15, 70)]  # before the walker occludes this person
    assert (alone.groupby("frame")["motion_state"].agg(set).map(lambda states: "deforming" in states)).mean() > 0.7
    assert (swayer["motion_state"] != "static").all()


def test_demo_moving_people_are_not_in_the_map(demo: tuple[Path, str]) -> None:
    vertices = plyfile.PlyData.read(demo[0] / "map.ply")["vertex"]
    points = np.stack([np.asarray(vertices[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    T_ge = np.array(json.loads((demo[0] / "metrics.json").read_text())["alignment"]["T_ge"])
    x, y, z = (points @ T_ge[:3, :3].T + T_ge[:3, 3]).T
    assert len(points) > 20_000
    # The corridor that the walker crosses is empty above the furniture, except for a few stray points.
    corridor = (np.abs(y - WALKER_Y) < 0.2) & (z > 1.0) & (z < 1.6) & (np.abs(x) < 1.2)
    assert corridor.sum() < 0.002 * len(points)


@pytest.mark.usefixtures("undrawn")
def test_estimated_depth_scale_is_reported_on_the_console_and_in_the_log(moment: Path, tmp_path: Path) -> None:
    folder = in_millimetres(moment, tmp_path / "millimetres")
    done = call_here("--seq", folder, "--out", "out", "--segmenter", "none", cwd=tmp_path)
    assert (done.exit_code, done.stderr) == (0, "")
    note = re.search(
        r"^note: millimetres: (depth scale 1000 \(millimetres\), estimated from .*)$", done.stdout, re.MULTILINE
    )
    assert note is not None and "in steps of 1; state depth_scale in camera.yaml" in note[1]
    assert f"WARNING {note[1]}" in (tmp_path / "out" / "run.log").read_text()
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["ate"]["rmse"] < 0.01 and not [text for text in metrics["notes"] if "depth_scale" in text]
