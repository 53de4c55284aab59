"""``run --resume`` as a user calls it: killed at any frame, a run goes on to the same bytes; what cannot is said."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.corpus import base
from helpers.corpus.outputs import at_frame, full_from_frame
from typer.testing import CliRunner, Result

from v3d_torch.batch.job import Job
from v3d_torch.batch.run_job import run_job
from v3d_torch.cli import run
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.runs.checkpoint import CHECKPOINT
from v3d_torch.runs.stored_run import read_run

FRAMES = 20
EVERY = ("--set", "checkpoint.interval=0", "--set", "checkpoint.max_time_share=1")
"""A checkpoint after every frame."""
SAME = ("trajectory.txt", "keyframes.txt", "dynamics.parquet", "map.ply", "trajectory.ply", "mesh.ply")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera along a wall of noise, before which somebody walks; ids of whom are in ``ids``."""
    folder = tmp_path_factory.mktemp("sequences") / "seq"
    stamps = [f"{1305031102 + i / 10:.6f}" for i in range(FRAMES)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "STAMPS", stamps)
        patch.setattr(base, "FRAMES", FRAMES)
        patch.setattr(base, "way", lambda frame: (frame, 4 + 2 * (frame % 4)))
        base.write_base(folder)
    (folder / "ids").mkdir()
    for i, stamp in enumerate(stamps):
        depth, ids = base.depth(), np.zeros((base.HEIGHT, base.WIDTH), np.uint8)
        walker = slice(10 + 2 * i, 26 + 2 * i)
        depth[20:, walker], ids[20:, walker] = 0.6 * base.SCALE, 1
        (folder / "depth" / f"{stamp}.png").write_bytes(base.png(depth))
        (folder / "ids" / f"{stamp}.png").write_bytes(base.png(ids))
    return folder


@pytest.fixture(scope="module", autouse=True)
def no_figures() -> Iterator[None]:
    """They take most of the time of a run so short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v3d_torch.runs.results.draw_run", lambda *_: None)
        yield


def asked(sequence: Path, out: Path, *more: str) -> list[str]:
    return ["--seq", str(sequence), "--masks", str(sequence / "ids"), "--out", str(out), "--mesh", *more]


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(run.app, [str(argument) for argument in arguments])


def assert_one_sentence(done: Result, *words: str) -> None:
    assert done.exit_code == 2 and (done.exception is None or isinstance(done.exception, SystemExit)), done.exc_info
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr


@pytest.fixture(scope="module")
def whole(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a run that was never stopped."""
    out = tmp_path_factory.mktemp("whole") / "out"
    done = call(*asked(sequence, out, "--save-masks", "--save-map", str(out.parent / "room.map"), *EVERY))
    assert done.exit_code == 0, done.stderr
    return out


def assert_same_results(out: Path, whole: Path, files: tuple[str, ...] = SAME) -> None:
    for name in files:
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    first, second = (json.loads((folder / "metrics.json").read_text()) for folder in (out, whole))
    for key in ("ate", "rpe", "status", "frames", "processed", "keyframes", "landmarks", "loops", "failure"):
        assert first[key] == second[key], key
    names = [{path.name for path in folder.iterdir()} - {"figures"} for folder in (out, whole)]
    assert names[0] == names[1]


def interrupted(sequence: Path, out: Path, frame: int, *more: str) -> Result:
    """Ctrl-C before a frame is read."""
    with at_frame(frame, lambda: os.kill(os.getpid(), signal.SIGINT)):
        return call(*asked(sequence, out, "--serial", *more))


# --- killed

ZYGOTE = """
import os, sys
import v3d_torch.runs.runner, v3d_torch.cli.run
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        null = os.open(os.devnull, os.O_RDWR)
        os.dup2(null, 0), os.dup2(null, 1)
        try:
            v3d_torch.cli.run.app(eval(line))
        except SystemExit as end:
            os._exit(end.code or 0)  # threads that a library started before the fork are not here to be ended
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Runs the command again and again in processes of its own, without the seconds that importing torch takes."""


@pytest.fixture
def start() -> Iterator[Callable[[list[str]], tuple[int, Callable[[], int]]]]:
    """Starts the command; gives the number of its process, and what waits for its exit code."""
    with subprocess.Popen(  # noqa: S603
        [sys.executable, "-c", ZYGOTE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        given, said = process.stdin, process.stdout

        def begin(arguments: list[str]) -> tuple[int, Callable[[], int]]:
            given.write(f"{arguments!r}\n")
            given.flush()
            return int(said.readline()), lambda: int(said.readline())

        yield begin
        given.close()


def frames_in(log: Path) -> int:
    return log.read_text().count(" INFO frame ") if log.is_file() else 0


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL, no fork")
def test_killed_at_ten_frames_it_ends_with_the_same_bytes(
    start: Callable[[list[str]], tuple[int, Callable[[], int]]], sequence: Path, whole: Path, tmp_path: Path
) -> None:
    out, delays = tmp_path / "out", random.Random(0)  # noqa: S311
    arguments = asked(sequence, out, "--save-masks", "--save-map", str(tmp_path / "room.map"), *EVERY)
    for frame in sorted(delays.sample(range(1, FRAMES), 10)):
        process, exit_code = start(arguments)
        seen, deadline = frames_in(out / "run.log"), time.monotonic() + 60
        done = json.loads((out / "metrics.json").read_text())["processed"] if (out / "metrics.json").exists() else 0
        while frames_in(out / "run.log") - seen < frame - done and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(0.05 * delays.random())  # anywhere in a frame, or in the writing of what there is
        os.kill(process, signal.SIGKILL)
        assert exit_code() == -signal.SIGKILL
        # What is there can be read. It may lack the frame that was being written, and one more where the time before
        # the kill came between the results and their checkpoint: then the run has gone on from the frame before.
        so_far = read_run(out)
        assert so_far.trajectory is not None and len(so_far.trajectory) == so_far.metrics.processed >= frame - 2
        assert so_far.metrics.failure is not None and so_far.metrics.failure.startswith("killed, or still running")
        assert (out / CHECKPOINT).is_file()
        arguments = ["--resume", str(out)]
    process, exit_code = start(arguments)
    assert exit_code() == 0
    assert_same_results(out, whole)
    for mask in (whole / "masks").iterdir():
        assert (out / "masks" / mask.name).read_bytes() == mask.read_bytes()
    assert (tmp_path / "room.map").read_bytes() == (whole.parent / "room.map").read_bytes()


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL")
def test_killed_as_a_user_starts_it(sequence: Path, whole: Path, tmp_path: Path) -> None:
    """From another folder, with relative paths."""
    out, command = tmp_path / "out", [sys.executable, "-m", "v3d_torch.run"]
    shutil.copytree(sequence, tmp_path / "seq", copy_function=os.link)
    arguments = asked(Path("seq"), Path("out"), "--save-masks", *EVERY)
    with subprocess.Popen([*command, *arguments], cwd=tmp_path, stdout=subprocess.DEVNULL) as process:  # noqa: S603
        deadline = time.monotonic() + 100
        while frames_in(out / "run.log") < 9 and time.monotonic() < deadline:
            time.sleep(0.005)
        process.kill()
    done = call("--resume", out)
    assert (done.exit_code, done.stderr) == (0, "")
    assert f"of {FRAMES} frames" in done.stdout and f"results: {out}" in done.stdout
    assert_same_results(out, whole)


# --- interrupted, full disks


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")
def test_after_ctrl_c_it_goes_on(sequence: Path, whole: Path, tmp_path: Path) -> None:
    """Without a checkpoint on the way: the last one is written when the run is told to end."""
    done = interrupted(sequence, tmp_path / "out", 10, "--save-masks")
    assert_one_sentence(done, f"interrupted after 11 of {FRAMES} frames", f"; go on with --resume {tmp_path / 'out'})")
    assert {CHECKPOINT, "map.ply"} <= {path.name for path in (tmp_path / "out").iterdir()}
    done = call("--resume", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert f"goes on after 11 of {FRAMES} frames" in done.stdout
    assert_same_results(tmp_path / "out", whole)


@pytest.mark.skipif(os.name == "nt", reason="no limits of Unix")
def test_a_disk_that_is_full_for_a_while_costs_checkpoints_only(
    sequence: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import resource

    out, limits = tmp_path / "out", resource.getrlimit(resource.RLIMIT_FSIZE)

    def free_again() -> None:
        assert (out / CHECKPOINT).stat().st_size > 10_000  # that of frame 5, whole
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    with full_from_frame(6), at_frame(11, free_again):
        done = call(*asked(sequence, out, "--serial", *EVERY))
    assert (done.exit_code, done.stderr) == (0, "")
    assert (
        done.stdout.count("note: while the run went on, ") == 1 and "cannot be written (File too large)" in done.stdout
    )
    assert "WARNING no checkpoint: " in (out / "run.log").read_text()
    assert (out / "trajectory.txt").read_bytes() == (whole / "trajectory.txt").read_bytes()
    assert not list(out.glob(".*")) and not (out / CHECKPOINT).exists()


@pytest.mark.skipif(os.name == "nt", reason="no limits of Unix")
def test_where_the_disk_stays_full_the_last_checkpoint_is_gone_on_with(
    sequence: Path, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with full_from_frame(6):
        done = call(*asked(sequence, out, "--save-masks", "--serial", *EVERY))
    assert_one_sentence(done, "cannot be written (File too large); free the disk or choose another folder")
    assert len((out / "trajectory.txt").read_text().splitlines()) == 6
    done = call("--resume", out)
    assert done.exit_code == 0 and f"goes on after 6 of {FRAMES} frames" in done.stdout, done.stderr
    assert_same_results(out, whole)


# --- what users get wrong


@pytest.fixture(scope="module")
def half(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("half") / "out"
    interrupted(sequence, out, 4)
    return out


@pytest.fixture
def out(half: Path, tmp_path: Path) -> Path:
    """An interrupted run."""
    shutil.copytree(half, tmp_path / "out")
    return tmp_path / "out"


def test_a_finished_run_says_so(whole: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in whole.rglob("*")}
    done = call("--resume", whole)
    assert (done.exit_code, done.stdout) == (
        0,
        f"{whole}: the run came to its end already; there is nothing left to do\n",
    )
    assert {path: path.stat().st_mtime_ns for path in whole.rglob("*")} == before


def test_where_there_is_no_checkpoint(tmp_path: Path) -> None:
    assert_one_sentence(call("--resume", tmp_path), f"{tmp_path}: has no checkpoint to go on from; give")
    assert_one_sentence(call("--resume", tmp_path / "no"), f"{tmp_path / 'no'}: is no folder; give")
    run = tmp_path / "seq" / "2026-01-01"
    run.mkdir(parents=True)
    (run / CHECKPOINT).touch()
    assert_one_sentence(call("--resume", tmp_path), f"; give the newest of the runs in it, {run}")
    assert_one_sentence(call("--resume", run / CHECKPOINT), f"is no folder; give the folder that {CHECKPOINT} is in")
    done = call()
    assert done.exit_code == 2 and "--resume" in done.stderr


def test_a_damaged_checkpoint_or_one_of_another_version(out: Path) -> None:
    path = out / CHECKPOINT
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    assert_one_sentence(call("--resume", out), f"{path}: is damaged or not a state of a run; start a new run")
    path.write_bytes(whole.replace(b"state 8", b"state 9", 1))
    assert_one_sentence(call("--resume", out), f"{path}: has state format 9, this program reads format 8")
    assert len((out / "trajectory.txt").read_text().splitlines()) == 5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--seed", "3"], "seed=3: says otherwise than the run in"),
        (["--config", "paper"], "--config paper: says otherwise"),
        (["--segmenter", "none"], "segmentation.source=none: says otherwise"),
        (["--save-masks"], "--save-masks: says otherwise"),
        (["--load-map", "room.map"], "--load-map: says otherwise"),
        (["--rgb-topic", "/rgb"], "--rgb-topic: says otherwise"),
        (["--out", "elsewhere"], "--out elsewhere: says otherwise"),
    ],
)
def test_options_that_say_otherwise(options: list[str], words: str, half: Path) -> None:
    assert_one_sentence(call("--resume", half, *options), words)


def test_the_whole_command_again_says_nothing_else(sequence: Path, whole: Path, out: Path) -> None:
    done = call(*asked(sequence, out, "--serial"), "--resume", out)
    assert done.exit_code == 0, done.stderr
    assert (out / "trajectory.txt").read_bytes() == (whole / "trajectory.txt").read_bytes()


def shorter(folder: Path) -> str:
    for name in ("rgb.txt", "depth.txt"):
        path = folder / name
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:16]))
    return f"it has 16 frames and had {FRAMES}"


def later(folder: Path) -> str:
    for name in ("rgb.txt", "depth.txt"):
        path = folder / name
        path.write_text(path.read_text().replace(".300000 ", ".310000 "))
    return "its frames have other times"


def of_another_camera(folder: Path) -> str:
    (folder / "camera.yaml").write_text(base.CAMERA.replace("fx: 64", "fx: 65"))
    return "its camera is another"


def repainted(folder: Path) -> str:
    path = sorted((folder / "rgb").iterdir())[4]
    image = cv2.imread(str(path))
    image[0, 0] += 1
    path.write_bytes(base.png(image))
    return "frame 4 shows something else"


@pytest.mark.parametrize("change", [shorter, later, of_another_camera, repainted])
def test_a_sequence_that_changed(change: Callable[[Path], str], sequence: Path, out: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "moved")
    what = change(tmp_path / "moved")
    done = call("--resume", out, "--seq", tmp_path / "moved")
    assert_one_sentence(
        done, f"{tmp_path / 'moved'}: is not as it was when the run in {out} began, {what}; put it back"
    )
    assert len((out / "trajectory.txt").read_text().splitlines()) == 5


def test_where_sequences_are_by_the_environment_is_not_asked(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = ["--seq", "seq", "--data-root", str(sequence.parent), "--segmenter", "none", "--serial"]
    with at_frame(3, lambda: os.kill(os.getpid(), signal.SIGINT)):
        call(*named, "--out", tmp_path / "named")
    monkeypatch.setenv("V3D_DATA", str(tmp_path / "elsewhere"))
    done = call("--resume", tmp_path / "named")
    assert done.exit_code == 0, done.stderr


def test_a_sequence_that_was_moved(sequence: Path, whole: Path, out: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "moved")
    done = call("--resume", out, "--seq", tmp_path / "moved")
    assert done.exit_code == 0, done.stderr
    assert (out / "trajectory.txt").read_bytes() == (whole / "trajectory.txt").read_bytes()


# --- runs of a batch


def test_a_run_of_a_batch_goes_on_where_it_was_ended(sequence: Path, tmp_path: Path) -> None:
    config = load_config(overrides=["segmentation.source=none", "prefetch=false"])

    def job(name: str, config: Config = config) -> Job:
        return Job("seq", str(sequence), FRAMES, None, "own", config, tmp_path / name)

    def stop(frames: int) -> None:
        if frames == 6:
            raise KeyboardInterrupt

    assert run_job(job("a"), lambda frames: None) is None
    assert run_job(job("b"), stop) == f"interrupted after 6 of {FRAMES} frames"
    seen: list[int] = []
    assert run_job(job("b"), seen.append) is None
    assert seen == list(range(7, FRAMES + 1))
    assert_same_results(tmp_path / "b", tmp_path / "a", SAME[:-1])
    # With other values, or a checkpoint that is damaged, it begins anew.
    assert run_job(job("c"), stop) is not None
    seen.clear()
    assert run_job(job("c", config.model_copy(update={"seed": 1})), seen.append) is None
    assert seen == list(range(1, FRAMES + 1))


# --- a map of an earlier run, streams


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")
def test_a_run_in_a_known_map_goes_on_without_its_file(sequence: Path, whole: Path, tmp_path: Path) -> None:
    room = tmp_path / "room.map"
    shutil.copy(whole.parent / "room.map", room)
    assert call(*asked(sequence, tmp_path / "a", "--load-map", str(room), "--serial")).exit_code == 0
    assert_one_sentence(interrupted(sequence, tmp_path / "b", 3, "--load-map", str(room)), "interrupted after 4")
    room.unlink()
    done = call("--resume", tmp_path / "b")
    assert done.exit_code == 0, done.stderr
    assert "known map" in done.stdout
    assert_same_results(tmp_path / "b", tmp_path / "a")


def test_a_stream_cannot_be_gone_on_with(sequence: Path, tmp_path: Path) -> None:
    from v3d_torch.datasets import load_sequence
    from v3d_torch.pipeline import Pipeline
    from v3d_torch.runs.checkpoint import write_checkpoint
    from v3d_torch.runs.request import RunRequest
    from v3d_torch.segmentation import NoSegmentation
    from v3d_torch.slam import V3DSLAM

    frames = load_sequence(str(sequence))

    class Live:
        name, camera, groundtruth = "live", frames.camera, None

        def __iter__(self) -> Iterator[object]:
            return iter([frames[0]])

    pipeline = Pipeline(Live(), V3DSLAM(frames.camera, NoSegmentation()))  # type: ignore[arg-type]
    assert pipeline().failure is None
    write_checkpoint(tmp_path, pipeline, RunRequest("realsense:"))
    assert_one_sentence(
        call("--resume", tmp_path), f"{tmp_path}: is the run of a stream (realsense:)", "cannot be gone on"
    )
    torch.set_num_threads(1)
