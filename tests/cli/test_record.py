"""Command ``v3d-torch record`` and the folders that it writes."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event

import pytest
import torch
from helpers.bags import DEPTH, INFO, RGB, MessageFactory
from helpers.commands import assert_error_line, invoke
from helpers.long_wall import CAMERA, Jump, Slide
from helpers.tiny_images import CAMERA_YAML, HEIGHT, WIDTH, colour_of, depth_of, save
from helpers.waiting import wait_until
from rich.console import Console

from v3d_torch.cli.record import app
from v3d_torch.cli.record_command import record_all, record_static
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence, tum_writer
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.io.files import write_png
from v3d_torch.runtime.hangup import handled_hangup
from v3d_torch.types import Instances, RGBDFrame

K = [30.0, 0, 15.5, 0, 31.25, 11.5, 0, 0, 1]
LISTS = {"rgb.txt", "depth.txt", "associations.txt", "camera.yaml"}


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "v3d_torch", "record", *map(str, arguments)]


call = partial(invoke, app)


def assert_equal(saved: RGBDSequence, source: RGBDSequence) -> None:
    assert saved.camera == source.camera
    assert saved.stamps.tolist() == pytest.approx(source.stamps.tolist(), abs=1e-6)
    for frame, original in zip(saved, source, strict=True):
        assert torch.equal(frame.image, original.image)
        torch.testing.assert_close(frame.depth, original.depth, rtol=1e-6, atol=0)
        assert frame.depth_delay == pytest.approx(original.depth_delay, abs=2e-6)


def test_bag_is_saved_as_folder(tmp_path: Path) -> None:
    make = MessageFactory("bag")
    info = make.info(WIDTH, HEIGHT, K, [0.1, -0.2, 0.003, 0.004, 0.05], K[:3] * 4)
    messages = [(INFO, 10.0, info)]
    for i in range(3):
        stamp = 1700000000 + i / 30
        messages.append((RGB, stamp, make.image(stamp, "rgb8", colour_of(i))))
        messages.append((DEPTH, stamp - 0.0125, make.image(stamp - 0.0125, "16UC1", depth_of(i))))
    bag = make.write(tmp_path / "take", messages)
    done = call("--seq", bag, "--out", tmp_path / "out [b]", "--rgb-topic", RGB)
    assert (done.exit_code, done.stderr, done.stdout.strip()) == (0, "", f"3 frames: {tmp_path / 'out [b]'}")
    assert_equal(load_sequence(str(tmp_path / "out [b]")), load_sequence(str(bag)))
    assert load_sequence(str(bag))[1].depth_delay == pytest.approx(-0.0125, abs=1e-6)


def test_ground_truth_of_bonn_is_transformed_once(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd_bonn_tiny"
    save(folder / "rgb" / "0.png", colour_of(0, 640, 480))
    save(folder / "depth" / "0.png", depth_of(0, 640, 480))
    (folder / "rgb.txt").write_text("10.0 rgb/0.png\n")
    (folder / "depth.txt").write_text("10.0 depth/0.png\n")
    (folder / "groundtruth.txt").write_text("10 1 2 3 0 0 0.6 0.8\n")
    done = call("--seq", folder, "--out", tmp_path / "rgbd_bonn_copy")
    assert (done.exit_code, done.stderr) == (0, "")
    source, saved = load_sequence(str(folder)), load_sequence(str(tmp_path / "rgbd_bonn_copy"))
    assert_equal(saved, source)
    assert source.groundtruth is not None and saved.groundtruth is not None
    torch.testing.assert_close(saved.groundtruth.T_wc, source.groundtruth.T_wc, atol=1e-8, rtol=0)


def test_damaged_ground_truth_keeps_all_frames(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    save(folder / "rgb" / "0.png", colour_of(0))
    save(folder / "depth" / "0.png", depth_of(0))
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text(f"10.0 {kind}/0.png\n")
    (folder / "camera.yaml").write_text(CAMERA_YAML)
    (folder / "groundtruth.txt").write_text("10 1 2 3 0 0 0 nan\n")
    done = call("--seq", folder, "--out", tmp_path / "out")
    assert_error_line(done, f"{folder / 'groundtruth.txt'}: line 1 has a number that is not finite", "frames")
    assert len(load_sequence(str(tmp_path / "out"))) == 1


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to another process")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, *handled_hangup()])
def test_signal_leaves_complete_folder(number: signal.Signals, tmp_path: Path) -> None:
    folder, out = tmp_path / "long", tmp_path / "out"
    save(folder / "rgb.png", colour_of(0, 640, 480))
    save(folder / "depth.png", depth_of(0, 640, 480))
    (folder / "associations.txt").write_text("".join(f"{i} rgb.png {i} depth.png\n" for i in range(20000)))
    (folder / "K.txt").write_text("500 500 320 240 1000 640 480")
    arguments = command("--seq", folder, "--out", out)
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:  # noqa: S603
        wait_until(lambda: len(list((out / "depth").glob("[0-9]*"))) >= 3, timeout=60, what="three frames are saved")
        process.send_signal(number)
        stdout, stderr = process.communicate(timeout=60)
    assert (process.returncode, stderr) == (0, "")
    saved = load_sequence(str(out))
    assert 3 <= len(saved) < 20000 and stdout == f"{len(saved)} frames: {out}\n"
    files = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    stamps = [f"{stamp:.6f}.png" for stamp in saved.stamps.tolist()]
    assert files == LISTS | {f"{kind}/{stamp}" for kind in ("rgb", "depth") for stamp in stamps}


def test_interrupt_while_waiting_for_a_frame_returns_the_number_of_frames(tmp_path: Path) -> None:
    """A second Ctrl-C ends a source that waits and that cannot be stopped."""

    class Waiting:
        name, camera, groundtruth = "waiting", CAMERA, None

        def __iter__(self) -> Iterator[RGBDFrame]:
            yield from (wall[0], wall[1])
            raise KeyboardInterrupt

    wall = Slide(0, 12, step=6)
    assert record_all(Waiting(), tmp_path / "out", threading.Event(), Console(quiet=True)) == 2
    assert len(load_sequence(str(tmp_path / "out"))) == 2


def test_interrupt_while_a_frame_is_written_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its images can be incomplete, so that the recording does not end as if all was saved."""

    def write(path: Path, image: object) -> None:
        if path.parent.name == "depth" and (tmp_path / "out" / "depth").exists():
            raise KeyboardInterrupt
        write_png(path, image)  # type: ignore[arg-type]

    monkeypatch.setattr(tum_writer, "write_png", write)
    with pytest.raises(KeyboardInterrupt):
        record_all(Slide(0, 18, step=6), tmp_path / "out", threading.Event(), Console(quiet=True))
    assert len(load_sequence(str(tmp_path / "out"))) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mapping: {enabled: false}", "mapping.enabled=false: there is no map"),
        (
            "segmentation: {source: masks}",
            "segmentation.source=masks: the folder of the id images is missing; only `run`",
        ),
    ],
)
def test_configuration_with_inputs_of_a_run_is_an_error(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(text)
    static = "--seq", "demo", "--static", "--config", tmp_path / "own.yaml", "--out", tmp_path / "out"
    assert_error_line(call(*static), message)
    assert not (tmp_path / "out").exists()


def test_numerics_of_a_static_recording_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        return replace(Instances.empty(*frame.image.shape[1:]), boxes=torch.full((1, 4), torch.nan))

    monkeypatch.setattr("v3d_torch.cli.record_command.make_segmenter", lambda *_: segment)
    (tmp_path / "own.yaml").write_text("check_numerics: true\nsegmentation: {source: none}")
    static = "--seq", "demo", "--static", "--config", tmp_path / "own.yaml", "--out", tmp_path / "out"
    assert_error_line(call(*static), "frame 0: segment.boxes is NaN")


def test_nonempty_folder_and_missing_camera_are_errors(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "diary.txt").write_text("")
    save(tmp_path / "rgb" / "1.png", colour_of(0))
    save(tmp_path / "depth" / "1.png", depth_of(0))
    (tmp_path / "camera.yaml").write_text(CAMERA_YAML)
    done = call("--seq", tmp_path, "--fps", "30", "--out", tmp_path / "full")
    assert_error_line(done, str(tmp_path / "full"), "already exists and is not an empty folder; choose another")
    assert_error_line(call("--out", tmp_path / "new"), "realsense: ")
    assert not (tmp_path / "new").exists()


def test_help_lists_options() -> None:
    done = call("--help", COLUMNS="80")
    assert done.exit_code == 0
    for option in ("seq", "out", "data-root", "camera", "rgb-topic", "depth-topic", "info-topic", "fps"):
        assert f"--{option}" in done.stdout


def test_static_recording_has_no_poses_of_frames_whose_place_is_a_guess(tmp_path: Path) -> None:
    """A reconstruction would put both places into one."""
    config = load_config(None, ("segmentation.source=none", "mapping.restart_after=0.3"))
    output = io.StringIO()
    frames, failure = record_static(Jump(), tmp_path / "out", config, Event(), Console(file=output))
    assert failure is None
    estimate = read_trajectory(tmp_path / "out" / "estimated_trajectory.txt")
    left_out = frames - len(estimate)
    assert left_out > 10 and len(estimate) >= 26
    assert f"note: {left_out} frames without a known pose are left out of estimated_trajectory.txt" in output.getvalue()


def test_folder_and_configuration_are_checked_before_the_source_is_opened(tmp_path: Path) -> None:
    """A download of half a gigabyte came first."""
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "diary.txt").write_text("")
    done = call("--seq", tmp_path / "missing", "--out", tmp_path / "full")
    assert_error_line(done, "already exists and is not an empty folder")
    done = call("--seq", tmp_path / "missing", "--static", "--config", tmp_path / "no.yaml", "--out", tmp_path / "new")
    assert_error_line(done, "no.yaml")
