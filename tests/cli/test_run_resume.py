"""``run --resume`` as a user calls it: killed runs that are resumed to the same bytes, and error messages."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.bag_messages import read_with_mcap
from helpers.commands import REPEATABLE_FILES, assert_error_line, assert_same_results, invoke
from helpers.corpus import base
from helpers.corpus.outputs import at_frame, full_from_frame
from helpers.forked_command import start_forked
from helpers.kills import kill_before_renaming, kill_while_tracking
from helpers.tum_folder_with_person import write_walker
from typer.testing import Result

from v3d_torch.batch.job import Job
from v3d_torch.batch.run_job import run_job
from v3d_torch.cli import run, run_command
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.realtime_playback import RealtimePlayback
from v3d_torch.errors import OutputError
from v3d_torch.io.state_file import VERSION
from v3d_torch.mapping.map_io import load_map, save_map
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.pipeline import ViewerGroup
from v3d_torch.runs import results, run_summary
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.metrics_file import read_metrics
from v3d_torch.runs.request import RunRequest, read_request
from v3d_torch.runs.result_folder import lock_results
from v3d_torch.runs.run_summary import way_to_resume
from v3d_torch.runs.segmentation_files import SegmentationFiles
from v3d_torch.runs.stored_run import read_run

pytestmark = pytest.mark.usefixtures("no_figures")

FRAMES = 20
CHECKPOINT_EVERY_FRAME = ("--set", "checkpoint.interval=0", "--set", "checkpoint.max_time_fraction=1")
ALL_MAPS = (*REPEATABLE_FILES, "mesh.ply", "occupancy.npz", "occupancy.bt")
assert_same_maps = partial(assert_same_results, files=ALL_MAPS)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walker(tmp_path_factory.mktemp("sequences") / "seq", FRAMES)


def run_arguments(sequence: Path, out: Path, *more: str) -> list[str]:
    return ["--seq", str(sequence), "--masks", str(sequence / "ids"), "--out", str(out), "--mesh", "--occupancy", *more]


call = partial(invoke, run.app)


@pytest.fixture(scope="module")
def whole_run(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of an uninterrupted run."""
    out = tmp_path_factory.mktemp("whole_run") / "out"
    done = call(
        *run_arguments(
            sequence, out, "--save-masks", "--save-map", str(out.parent / "room.map"), *CHECKPOINT_EVERY_FRAME
        )
    )
    assert done.exit_code == 0, done.stderr
    return out


def interrupt_run(sequence: Path, out: Path, frame: int, *more: str) -> Result:
    """Start a run and press Ctrl-C before a frame is read."""
    with at_frame(frame, lambda: os.kill(os.getpid(), signal.SIGINT)):
        return call(*run_arguments(sequence, out, "--serial", *more))


# --- killed runs


KILLS = (
    (partial(kill_while_tracking, 4), 3),
    (partial(kill_before_renaming, RunFile.OBJECTS, 3), 5),
    (partial(kill_before_renaming, RunFile.CHECKPOINT, 4), 9),
    (partial(kill_while_tracking, FRAMES - 8), FRAMES - 1),
    (partial(kill_before_renaming, RunFile.MAP, 1), FRAMES),
)
"""Moments at which a run and its resumed runs are killed, and the number of frames in the results then.

They are: while frame 4 is tracked; between the trajectory and ``metrics.json`` of frame 6; between the results of frame
9 and their checkpoint, so that the next run begins after frame 8; while the last frame is tracked; while the results of
the whole run are written.
"""


def run_until_killed(kill: Callable[[], None], *arguments: str, cwd: Path) -> None:
    process = start_forked(*arguments, cwd=cwd, before=kill)
    process.join(timeout=300)
    assert process.exitcode == -signal.SIGKILL


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL")
def test_run_killed_at_five_moments_resumes_to_the_same_bytes(sequence: Path, whole_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = run_arguments(
        sequence, out, "--save-masks", "--save-map", str(tmp_path / "room.map"), *CHECKPOINT_EVERY_FRAME
    )
    for kill, frames in KILLS:
        run_until_killed(kill, *arguments, cwd=tmp_path)
        stored = read_run(out)
        assert stored.trajectory is not None and len(stored.trajectory) == stored.metrics.processed == frames
        assert stored.metrics.failure is not None and stored.metrics.failure.startswith("killed or still running")
        assert (out / RunFile.CHECKPOINT).is_file()
        arguments = ["--resume", str(out)]
    done = call(*arguments)
    assert (done.exit_code, done.stderr) == (0, "")
    assert_same_maps(out, whole_run)
    for mask in (whole_run / "masks").iterdir():
        assert (out / "masks" / mask.name).read_bytes() == mask.read_bytes()
    assert (tmp_path / "room.map").read_bytes() == (whole_run.parent / "room.map").read_bytes()


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL")
def test_killed_run_with_relative_paths_resumes_from_another_folder(
    sequence: Path, whole_run: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(sequence, tmp_path / "seq", copy_function=os.link)
    arguments = run_arguments(Path("seq"), Path("out"), "--save-masks", *CHECKPOINT_EVERY_FRAME)
    run_until_killed(partial(kill_while_tracking, 10), *arguments, cwd=tmp_path)
    done = call("--resume", out)
    assert (done.exit_code, done.stderr) == (0, "")
    assert f"of {FRAMES} frames" in done.stdout and f"results: {out}" in done.stdout
    assert_same_maps(out, whole_run)


# --- interrupted runs, full disks


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")
def test_interrupted_run_resumes_to_the_same_results(sequence: Path, whole_run: Path, tmp_path: Path) -> None:
    """No checkpoint is due before Ctrl-C: the only one is written when the run ends."""
    done = interrupt_run(sequence, tmp_path / "out", 10, "--save-masks")
    assert_error_line(done, f"interrupted after 11 of {FRAMES} frames", f"; resume with --resume {tmp_path / 'out'})")
    assert {RunFile.CHECKPOINT, "map.ply"} <= {path.name for path in (tmp_path / "out").iterdir()}
    done = call("--resume", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert f"resuming after 11 of {FRAMES} frames" in done.stdout
    assert_same_maps(tmp_path / "out", whole_run)


def test_report_of_the_interrupted_run_is_removed_when_it_is_resumed(out: Path) -> None:
    (out / RunFile.REPORT).write_text("interrupted")
    done = call("--resume", out)
    assert done.exit_code == 0 and not (out / RunFile.REPORT).exists(), done.stderr


@pytest.mark.skipif(os.name == "nt", reason="no file size limits")
def test_temporarily_full_disk_only_prevents_checkpoints(sequence: Path, whole_run: Path, tmp_path: Path) -> None:
    import resource

    out, limits = tmp_path / "out", resource.getrlimit(resource.RLIMIT_FSIZE)

    def free_disk() -> None:
        assert (out / RunFile.CHECKPOINT).stat().st_size > 10_000  # the complete checkpoint of frame 5
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    with full_from_frame(6), at_frame(11, free_disk):
        done = call(*run_arguments(sequence, out, "--serial", *CHECKPOINT_EVERY_FRAME))
    assert (done.exit_code, done.stderr) == (0, "")
    assert "note: no checkpoint" not in done.stdout  # later ones were saved
    assert (out / "run.log").read_text().count("WARNING no checkpoint: ") == 1
    assert (out / "trajectory.txt").read_bytes() == (whole_run / "trajectory.txt").read_bytes()
    assert not list(out.glob(".*")) and not (out / RunFile.CHECKPOINT).exists()


@pytest.mark.skipif(os.name == "nt", reason="no file size limits")
def test_run_on_full_disk_resumes_from_its_last_checkpoint(sequence: Path, whole_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with full_from_frame(6):
        done = call(*run_arguments(sequence, out, "--save-masks", "--serial", *CHECKPOINT_EVERY_FRAME))
    message = "cannot be written (File too large); free the disk or choose another folder"
    assert_error_line(done, f"{message}; resume with --resume {out}\n")
    assert len((out / "trajectory.txt").read_text().splitlines()) == 6
    done = call("--resume", out)
    assert done.exit_code == 0 and f"resuming after 6 of {FRAMES} frames" in done.stdout, done.stderr
    assert_same_maps(out, whole_run)


def fail_to_write(*_: object, **__: object) -> None:
    raise OutputError("map.ply: cannot be written (No space left on device); free the disk")


def test_run_on_a_disk_that_is_full_at_its_end_resumes_after_the_last_frame(
    sequence: Path, whole_run: Path, tmp_path: Path
) -> None:
    """The run is too short for an autosave."""
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results, "write_ply", fail_to_write)
        done = call(*run_arguments(sequence, out, "--save-masks"))
    message = "map.ply: cannot be written (No space left on device); free the disk"
    assert_error_line(done, f"{message}; resume with --resume {out}\n")
    metrics = read_metrics(out / "metrics.json")
    assert (metrics.failure, metrics.processed) == (message, FRAMES)
    done = call("--resume", out)
    assert done.exit_code == 0 and f"resuming after {FRAMES} of {FRAMES} frames" in done.stdout, done.stderr
    assert_same_maps(out, whole_run)


def test_folder_in_the_way_to_resume_is_quoted(sequence: Path, tmp_path: Path) -> None:
    folder, frames = tmp_path / "my run", load_sequence(str(sequence))
    folder.mkdir()
    assert way_to_resume(folder, frames) == ""
    (folder / RunFile.CHECKPOINT).touch()
    assert way_to_resume(folder, frames) == f"; resume with --resume '{folder}'"
    assert way_to_resume(folder, RealtimePlayback(frames)) == ""  # its frames are gone


def test_error_of_a_folder_that_becomes_locked_names_no_way_to_resume(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another run has begun between the check and the lock; the checkpoint is its own."""
    out = tmp_path / "out"
    out.mkdir()
    (out / RunFile.LOG).touch()
    (out / RunFile.CHECKPOINT).touch()
    monkeypatch.setattr(run_command, "check_unlocked", lambda folder: None)
    monkeypatch.setattr(run_command, "_check_contents", lambda *_, **__: False)  # the folder was empty then
    with lock_results(out):
        done = call(*run_arguments(sequence, out))
    assert_error_line(done, f"{out}: another run or batch is writing to this folder")
    assert "--resume" not in done.stderr


def test_message_of_ctrl_c_while_results_are_written_names_the_way_to_resume(
    sequence: Path, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(results, "write_ply", interrupt)
        done = call(*run_arguments(sequence, out, "--save-masks", *CHECKPOINT_EVERY_FRAME))
    assert_error_line(done, f"{out}: interrupted before the results were written; resume with --resume {out}")
    assert call("--resume", out).exit_code == 0
    assert_same_maps(out, whole_run)


def test_errors_of_results_and_recording_are_both_reported(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OutputError("demo.mcap: cannot be written")

    monkeypatch.setattr(ViewerGroup, "finish", fail)
    monkeypatch.setattr(results, "write_ply", fail_to_write)
    done = call(*run_arguments(sequence, tmp_path / "out"))
    assert_error_line(done, "error: demo.mcap: cannot be written; map.ply: cannot be written (No space left on device)")
    assert " ERROR demo.mcap: cannot be written\n" in (tmp_path / "out" / "run.log").read_text()


# --- map files


def write_earlier_map(path: Path, sequence: Path) -> Path:
    config = Config()
    save_map(path, SparseMap(config.mapping, config.features, load_sequence(str(sequence)).camera))
    return path


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")
def test_interrupted_run_keeps_an_earlier_map_file_until_it_is_resumed(
    sequence: Path, whole_run: Path, tmp_path: Path
) -> None:
    out, room = tmp_path / "out", write_earlier_map(tmp_path / "room.map", sequence)
    yesterday = room.read_bytes()
    done = interrupt_run(sequence, out, 4, "--save-map", str(room))
    assert_error_line(done, f"interrupted after 5 of {FRAMES} frames", f"; resume with --resume {out})")
    beside = tmp_path / "room.partial.map"
    warning = f"warning: {room}: was not overwritten, because the run ended early; its map is saved to {beside}\n"
    assert warning in done.stdout
    assert room.read_bytes() == yesterday
    assert load_map(beside, load_sequence(str(sequence)).camera, Config()).map.active_keyframes
    done = call("--resume", out)
    assert done.exit_code == 0 and "was not overwritten" not in done.stdout, done.stderr
    assert room.read_bytes() == (whole_run.parent / "room.map").read_bytes()
    assert not beside.exists()


def test_viewer_that_fails_after_the_last_frame_does_not_keep_the_map_from_being_saved(
    sequence: Path, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OutputError("demo.rrd: cannot be written")

    room = write_earlier_map(tmp_path / "room.map", sequence)
    monkeypatch.setattr(ViewerGroup, "finish", fail)
    assert_error_line(call(*run_arguments(sequence, tmp_path / "out", "--save-map", str(room))), "demo.rrd: cannot be")
    assert room.read_bytes() == (whole_run.parent / "room.map").read_bytes()


@pytest.mark.parametrize("options", [CHECKPOINT_EVERY_FRAME, ()], ids=["with checkpoints", "too short for checkpoints"])
def test_run_whose_map_file_cannot_be_written_keeps_its_results_and_resumes(
    sequence: Path, whole_run: Path, tmp_path: Path, options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    differences: list[str | None] = []
    monkeypatch.setattr(run_summary, "make_paper_table", lambda _, __, difference: differences.append(difference))
    out, room = tmp_path / "out", tmp_path / "maps" / "room.map"

    def remove_folder() -> None:
        room.parent.rmdir()
        room.parent.write_text("")

    with at_frame(10, remove_folder):
        done = call(*run_arguments(sequence, out, "--save-masks", "--serial", "--save-map", str(room), *options))
    assert differences == [None]  # not a part of the sequence
    assert_error_line(done, f"{room}: cannot be written", f"frames before are in {out}; resume with --resume {out})")
    assert "ATE rmse" in done.stdout
    assert (out / "map.ply").read_bytes() == (whole_run / "map.ply").read_bytes()
    room.parent.unlink()
    done = call("--resume", out)
    assert done.exit_code == 0, done.stderr
    assert room.read_bytes() == (whole_run.parent / "room.map").read_bytes()
    assert_same_maps(out, whole_run)


def test_file_put_in_place_of_the_map_during_the_run_stays(sequence: Path, whole_run: Path, tmp_path: Path) -> None:
    out, room, beside = tmp_path / "out", tmp_path / "room.map", tmp_path / "room.partial.map"
    beside.write_text("my own notes")
    with at_frame(10, lambda: room.write_text("my notes")):
        done = call(*run_arguments(sequence, out, "--save-masks", "--serial", "--save-map", str(room)))
    assert_error_line(done, f"{room}: exists and is not a map", f"; resume with --resume {out})")
    assert room.read_text() == "my notes" and (out / "map.ply").is_file()
    room.unlink()
    done = call("--resume", out)
    assert done.exit_code == 0, done.stderr
    assert room.read_bytes() == (whole_run.parent / "room.map").read_bytes()
    assert beside.read_text() == "my own notes"


@pytest.mark.parametrize("has_earlier", [True, False])
def test_run_without_keyframes_writes_no_map_file(has_earlier: bool, sequence: Path, tmp_path: Path) -> None:
    dark, room = tmp_path / "dark", tmp_path / "room.map"
    shutil.copytree(sequence, dark)
    for path in (dark / "rgb").iterdir():
        path.write_bytes(base.png(np.zeros_like(cv2.imread(str(path)))))
    earlier = write_earlier_map(room, sequence).read_bytes() if has_earlier else None
    done = call(*run_arguments(dark, tmp_path / "out", "--save-map", str(room)))
    assert_error_line(done, "the colour images are uniform")
    assert f"warning: {room}: was not written, because the map of this run has no keyframes\n" in done.stdout
    assert (room.read_bytes() if room.exists() else None) == earlier


# --- mistakes of the user


@pytest.fixture(scope="module")
def half_run(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("half") / "out"
    interrupt_run(sequence, out, 4)
    return out


@pytest.fixture
def out(half_run: Path, tmp_path: Path) -> Path:
    """Copy of the results of an interrupted run."""
    shutil.copytree(half_run, tmp_path / "out")
    return tmp_path / "out"


def test_recording_of_the_first_frames_is_not_replaced(out: Path) -> None:
    recording, before = out.parent / "run.rrd", (out / "metrics.json").read_bytes()
    recording.write_text("the first frames")
    done = call("--resume", out, "--rerun", recording)
    assert_error_line(done, f"{recording}: already exists; delete it, or choose another file with --rerun")
    assert recording.read_text() == "the first frames"
    assert (out / "metrics.json").read_bytes() == before and (out / RunFile.CHECKPOINT).is_file()


def test_bag_of_a_resumed_run_has_the_remaining_frames_and_its_own_odom(out: Path, tmp_path: Path) -> None:
    done = call("--resume", out, "--bag", tmp_path / "rest.mcap")
    assert (done.exit_code, done.stderr) == (0, "")
    messages = read_with_mcap(tmp_path / "rest.mcap")
    assert len(messages["/odom"]) == FRAMES - 5 and len(messages["/path"][-1][1].poses) == FRAMES
    first = messages["/odom"][0][1].pose.pose.position
    assert (first.x, first.y, first.z) == pytest.approx((0, 0, 0), abs=1e-9)


def test_sequence_that_was_moved_is_an_error_that_names_the_option(sequence: Path, tmp_path: Path) -> None:
    room, out = tmp_path / "room", tmp_path / "out"
    shutil.copytree(sequence, room)
    interrupt_run(room, out, 4)
    room.rename(tmp_path / "moved")
    message = f"{room}: the sequence of the run in {out} is not there; give its new place with --seq"
    assert_error_line(call("--resume", out), message)


def test_new_run_does_not_replace_an_interrupted_one(sequence: Path, out: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    done = call("--seq", sequence, "--out", out)
    message = f"has an interrupted run; continue it with --resume {out}, choose another folder with --out, or delete"
    assert_error_line(done, f"{out}: {message} this one")
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


def test_finished_run_has_nothing_to_resume(whole_run: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in whole_run.rglob("*")}
    done = call("--resume", whole_run)
    assert (done.exit_code, done.stdout) == (0, f"{whole_run}: the run is finished; nothing to resume\n")
    assert {path: path.stat().st_mtime_ns for path in whole_run.rglob("*")} == before


@pytest.mark.parametrize("option", [("--seed", "5"), ("--config", "paper"), ("--save-map", "room.npz"), ("--fps", "9")])
def test_option_that_a_finished_run_did_not_have_is_rejected(whole_run: Path, option: tuple[str, str]) -> None:
    assert_error_line(call("--resume", whole_run, *option), f"{option[0]}", f"conflicts with the run in {whole_run}")


def test_missing_checkpoint_is_rejected_with_a_suggestion(tmp_path: Path) -> None:
    assert_error_line(
        call("--resume", tmp_path), f"{tmp_path}: has no checkpoint; pass the folder of a run that ended early"
    )
    assert_error_line(
        call("--resume", tmp_path / "no"),
        f"{tmp_path / 'no'}: is not a folder; pass the folder of a run that ended early",
    )
    newest = tmp_path / "seq" / "2026-01-01"
    newest.mkdir(parents=True)
    (newest / RunFile.CHECKPOINT).touch()
    assert_error_line(call("--resume", tmp_path), f"{tmp_path}: has no checkpoint; pass the newest run in it, {newest}")
    assert_error_line(
        call("--resume", newest / RunFile.CHECKPOINT),
        f"{newest / RunFile.CHECKPOINT}: is not a folder; pass its folder, {newest}",
    )
    done = call()
    assert done.exit_code == 2 and "--resume" in done.stderr


def test_damaged_checkpoint_or_one_of_another_version_is_rejected(out: Path) -> None:
    path = out / RunFile.CHECKPOINT
    content = path.read_bytes()
    path.write_bytes(content[:-10])
    assert_error_line(call("--resume", out), f"{path}: is damaged or not a state of a run; start a new run")
    path.write_bytes(content.replace(b"state %d" % VERSION, b"state 9", 1))
    assert_error_line(
        call("--resume", out), f"{path}: has state format 9, this program reads format {VERSION}; continue with"
    )
    assert len((out / "trajectory.txt").read_text().splitlines()) == 5


@pytest.mark.parametrize(
    ("options", "option"),
    [
        (["--seed", "3"], "--seed 3"),
        (["--set", "features.count=77"], "--set features.count=77"),
        (["--localise"], "--localise"),
        (["--fps", "0"], "--fps"),
        (["--config", "paper"], "--config paper"),
        (["--segmenter", "none"], "--segmenter none"),
        (["--save-masks"], "--save-masks"),
        (["--load-map", "room.map"], "--load-map"),
        (["--rgb-topic", "/rgb"], "--rgb-topic"),
        (["--out", "elsewhere"], "--out elsewhere"),
    ],
)
def test_conflicting_option_is_rejected(options: list[str], option: str, half_run: Path) -> None:
    done = call("--resume", half_run, *options)
    assert_error_line(done, f"error: {option}: conflicts with the run in {half_run}; remove this option\n")


def test_same_options_beside_resume_do_not_conflict(sequence: Path, whole_run: Path, out: Path) -> None:
    done = call(*run_arguments(sequence, out, "--serial"), "--resume", out)
    assert done.exit_code == 0, done.stderr
    assert (out / "trajectory.txt").read_bytes() == (whole_run / "trajectory.txt").read_bytes()


def remove_row(folder: Path, frame: int) -> None:
    for name in ("rgb.txt", "depth.txt"):
        rows = (folder / name).read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(rows[:frame] + rows[frame + 1 :]))


def change_file(folder: Path, frame: int) -> Path:
    """Replace a colour image by another one."""
    path = sorted((folder / "rgb").iterdir())[frame]
    image = cv2.imread(str(path))
    image[:30] //= 2
    path.write_bytes(base.png(image))
    return path


def remove_row_and_its_file(folder: Path) -> None:
    remove_row(folder, 12)
    sorted((folder / "rgb").iterdir())[12].unlink()


def shift_timestamps(folder: Path) -> str:
    for name in ("rgb.txt", "depth.txt"):
        path = folder / name
        path.write_text(path.read_text().replace(".300000 ", ".310000 "))
    return "the frame at 1305031102.300000 s is missing"


def remove_processed_frame(folder: Path) -> str:
    remove_row(folder, 2)
    return "the frame at 1305031102.200000 s is missing"


def add_frame(folder: Path, decimals: str = "150000") -> str:
    for name in ("rgb.txt", "depth.txt"):
        path = folder / name
        row = path.read_text().splitlines()[4].replace(".400000 ", f".{decimals} ", 1)
        path.write_text(f"{path.read_text()}{row}\n")
    return f"the frame at 1305031102.{decimals} s is new"


def add_frame_before_last_processed_frame(folder: Path) -> str:
    return add_frame(folder, "350000")


def cut_before_last_processed_frame(folder: Path) -> str:
    for name in ("rgb.txt", "depth.txt"):
        path = folder / name
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:4]))
    return "the frame at 1305031102.400000 s is missing"


def change_processed_file(folder: Path) -> str:
    return f"{change_file(folder, 2)} has changed"


def change_camera(folder: Path) -> str:
    (folder / "camera.yaml").write_text(base.CAMERA.replace("fx: 64", "fx: 65"))
    return "another camera"


def change_last_image(folder: Path) -> str:
    path = sorted((folder / "rgb").iterdir())[4]
    size, image = path.stat().st_size, cv2.imread(str(path))
    for change in range(1, 256):  # to an image whose file has the same size
        image[0, 0] += np.uint8(change)
        if len(base.png(image)) == size:
            break
    path.write_bytes(base.png(image))
    return "frame 4 shows another image"


CHANGES = (
    *(shift_timestamps, remove_processed_frame, add_frame, add_frame_before_last_processed_frame),
    *(cut_before_last_processed_frame, change_camera, change_processed_file, change_last_image),
)


@pytest.mark.parametrize("change", CHANGES)
def test_changed_sequence_is_rejected(change: Callable[[Path], str], sequence: Path, out: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "moved")
    difference = change(tmp_path / "moved")
    done = call("--resume", out, "--seq", tmp_path / "moved")
    assert_error_line(
        done,
        f"{tmp_path / 'moved'}: has changed since the run in {out} began ({difference}); restore the sequence, or",
    )
    assert len((out / "trajectory.txt").read_text().splitlines()) == 5


@pytest.mark.parametrize(
    "change", [lambda folder: remove_row(folder, 7), lambda folder: change_file(folder, 9), remove_row_and_its_file]
)
def test_run_resumes_if_only_frames_that_were_not_processed_have_changed(
    change: Callable[[Path], object], sequence: Path, out: Path, tmp_path: Path
) -> None:
    shutil.copytree(sequence, tmp_path / "seq")
    change(tmp_path / "seq")
    expected = call(*run_arguments(tmp_path / "seq", tmp_path / "expected", "--serial"))
    assert expected.exit_code == 0, expected.stderr
    done = call("--resume", out, "--seq", tmp_path / "seq")
    assert done.exit_code == 0, done.stderr
    assert_same_maps(out, tmp_path / "expected")


def draw_another_person(ids: Path) -> Path:
    """Change the id image of a processed frame."""
    path = sorted(ids.iterdir())[2]
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[:10, ::3] = 2
    path.write_bytes(base.png(image))
    return path


def write_labels(ids: Path) -> Path:
    (ids / "labels.yaml").write_text("1: chair\n")
    return ids / "labels.yaml"


def remove_mask(ids: Path) -> Path:
    path = sorted(ids.iterdir())[3]
    path.unlink()
    return path


@pytest.mark.parametrize("change", [draw_another_person, write_labels, remove_mask])
def test_run_with_other_id_images_is_not_resumed(
    change: Callable[[Path], Path], sequence: Path, tmp_path: Path
) -> None:
    shutil.copytree(sequence, tmp_path / "seq")
    out = tmp_path / "out"
    interrupt_run(tmp_path / "seq", out, 4)
    changed = change(tmp_path / "seq" / "ids")
    assert_error_line(
        call("--resume", out),
        f"error: {changed}: has changed since the run in {out} began; restore it, or start a new run\n",
    )
    assert len((out / "trajectory.txt").read_text().splitlines()) == 5


def test_run_whose_later_id_images_have_changed_is_resumed(sequence: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "seq")
    interrupt_run(tmp_path / "seq", tmp_path / "out", 4)
    path = sorted((tmp_path / "seq" / "ids").iterdir())[9]
    path.write_bytes(base.png(np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))))
    done = call("--resume", tmp_path / "out")
    assert (done.exit_code, done.stderr) == (0, "")


def test_resumed_run_ignores_data_folder_of_the_environment(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = ["--seq", "seq", "--data-root", str(sequence.parent), "--segmenter", "none", "--serial"]
    with at_frame(3, lambda: os.kill(os.getpid(), signal.SIGINT)):
        call(*named, "--out", tmp_path / "named")
    monkeypatch.setenv("V3D_DATA", str(tmp_path / "elsewhere"))
    done = call("--resume", tmp_path / "named")
    assert done.exit_code == 0, done.stderr


def test_run_of_sequence_found_by_the_variable_resumes_without_it(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("V3D_DATA", str(sequence.parent))
    with at_frame(3, lambda: os.kill(os.getpid(), signal.SIGINT)):
        call("--seq", "seq", "--segmenter", "none", "--serial", "--out", tmp_path / "named")
    monkeypatch.delenv("V3D_DATA")
    assert read_request(tmp_path / "named").data_root == str(sequence.parent)
    done = call("--resume", tmp_path / "named")
    assert done.exit_code == 0, done.stderr


def test_run_of_moved_sequence_resumes(sequence: Path, whole_run: Path, out: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "moved")
    done = call("--resume", out, "--seq", tmp_path / "moved")
    assert done.exit_code == 0, done.stderr
    assert (out / "trajectory.txt").read_bytes() == (whole_run / "trajectory.txt").read_bytes()


# --- runs of a batch


def test_interrupted_run_of_a_batch_resumes(sequence: Path, tmp_path: Path) -> None:
    config = load_config(overrides=["segmentation.source=none", "prefetch=false"])

    def job(name: str) -> Job:
        return Job("seq", FRAMES, "", "own", RunRequest(str(sequence), config), tmp_path / name)

    def stop(count: int) -> None:
        if count == 6:
            raise KeyboardInterrupt

    assert run_job(job("a"), lambda _: None) is None
    assert run_job(job("b"), stop) == f"interrupted after 6 of {FRAMES} frames"
    frames: list[int] = []
    assert run_job(job("b"), frames.append) is None
    assert frames == list(range(7, FRAMES + 1))
    assert_same_results(tmp_path / "b", tmp_path / "a")


# --- loaded maps, streams


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")
def test_run_in_loaded_map_resumes_without_the_map_file(sequence: Path, whole_run: Path, tmp_path: Path) -> None:
    room = tmp_path / "room.map"
    shutil.copy(whole_run.parent / "room.map", room)
    assert call(*run_arguments(sequence, tmp_path / "a", "--load-map", str(room), "--serial")).exit_code == 0
    assert_error_line(interrupt_run(sequence, tmp_path / "b", 3, "--load-map", str(room)), "interrupted after 4")
    room.unlink()
    done = call("--resume", tmp_path / "b")
    assert done.exit_code == 0, done.stderr
    assert "loaded map" in done.stdout
    assert_same_maps(tmp_path / "b", tmp_path / "a")


def test_live_stream_cannot_be_resumed(sequence: Path, tmp_path: Path) -> None:
    from v3d_torch.pipeline import Pipeline
    from v3d_torch.runs.checkpoint import FileSizes, write_checkpoint
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
    files = SegmentationFiles(None, NoSegmentation(), pipeline.sequence)
    write_checkpoint(tmp_path, pipeline, RunRequest("realsense:", Config()), FileSizes(pipeline.sequence), files)
    assert_error_line(
        call("--resume", tmp_path),
        f"{tmp_path}: the run of a live stream (realsense:) cannot be resumed; its results so far are in",
        " in trajectory.txt\n",
    )
