"""RealSense streams from a simulated camera and from recordings, and the conversion of their calibration."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
import torch
from helpers.simulated_realsense import (
    BASELINE,
    COLOUR_K,
    DEPTH_K,
    FPS,
    HEIGHT,
    WIDTH,
    SimulatedDevice,
    make_intrinsics,
    rs,
)
from helpers.tiny_images import CAMERA_YAML, as_rgb, colour_of
from helpers.waiting import wait_until
from typer.testing import CliRunner

from v3d_torch.cli import record, run
from v3d_torch.datasets import RGBDSequence, RGBDStream, SourceOptions, load_sequence, open_source
from v3d_torch.datasets.base import LiveStream
from v3d_torch.datasets.realsense import RealSenseCamera, RealSenseStream
from v3d_torch.datasets.realsense.device import PipelineDevice, open_live_device
from v3d_torch.datasets.realsense.realsense_camera import open_realsense_camera
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.live import LiveSLAM
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import TrackingStatus

OPEN_LIVE_DEVICE = "v3d_torch.datasets.realsense.realsense_camera.open_live_device"


def take_frames(stream: RGBDStream, count: int) -> list[Any]:
    frames = iter(stream)
    try:
        return [next(frames) for _ in range(count)]
    finally:
        frames.close()  # type: ignore[attr-defined]


# --- live cameras


@pytest.fixture(scope="module")
def live() -> Iterator[SimpleNamespace]:
    camera = SimulatedDevice()
    stream = RealSenseStream("simulated", lambda: camera)
    frames = take_frames(stream, 5)
    yield SimpleNamespace(camera=camera, stream=stream, frames=frames)


def test_live_frames_are_in_order_with_their_own_depth(live: SimpleNamespace) -> None:
    assert isinstance(live.stream, RGBDStream) and not isinstance(live.stream, RGBDSequence)
    assert live.stream.camera == PinholeCamera(*COLOUR_K, WIDTH, HEIGHT, depth_scale=1000)
    for index, frame in enumerate(live.frames):
        assert frame.index == index
        number = round((frame.stamp - live.camera.first_stamp / 1000) * FPS)
        assert frame.stamp == pytest.approx(live.camera.first_stamp / 1000 + number / FPS, abs=1e-5)
        assert np.array_equal(as_rgb(frame.image), colour_of(number, WIDTH, HEIGHT))
        assert (frame.depth.dtype, frame.depth.shape) == (torch.float32, (1, HEIGHT, WIDTH))
        assert float(frame.depth[0, 24, 38]) == pytest.approx(1 - number / 1000)  # depth of the same frame
    stamps = [frame.stamp for frame in live.frames]
    assert stamps == sorted(set(stamps))


def test_convention_depth_is_aligned_to_colour(live: SimpleNamespace) -> None:
    """The corners of the board are at their projections into the colour camera."""
    frame = live.frames[0]
    number = round((frame.stamp - live.camera.first_stamp / 1000) * FPS)
    z = 1 - number / 1000
    rows, columns = torch.nonzero((frame.depth[0] > 0.9) & (frame.depth[0] < 1.1), as_tuple=True)
    (fx, fy, cx, cy), (gx, gy, px, py) = COLOUR_K, DEPTH_K
    left, right = (fx * ((edge - px) / gx + BASELINE / z) + cx for edge in (23.5, 39.5))
    top, bottom = (fy * (edge - py) / gy + cy for edge in (15.5, 31.5))
    bounds = [columns.min() - 0.5, columns.max() + 0.5, rows.min() - 0.5, rows.max() + 0.5]
    assert [float(edge) for edge in bounds] == pytest.approx([left, right, top, bottom], abs=1)


def test_yielded_frames_do_not_share_memory(live: SimpleNamespace) -> None:
    """librealsense reuses the memory of a frame, so that each image must be a copy."""
    assert len({frame.image.numpy().tobytes() for frame in live.frames}) == len(live.frames)


def test_depth_delay_is_the_difference_of_the_stamps_of_a_frame() -> None:
    for kind in (RealSenseStream, RealSenseCamera):
        camera = SimulatedDevice(depth_delay=0.004)
        frames = take_frames(kind("simulated", lambda camera=camera: camera), 3)
        assert [frame.depth_delay for frame in frames] == pytest.approx([0.004] * 3, abs=1e-5)


@pytest.mark.parametrize(
    ("colour", "depth", "delay", "expected"),
    [
        ("global_time", "global_time", -0.015, -0.015),
        ("hardware_clock", "hardware_clock", 0.004, 0.004),
        ("global_time", "hardware_clock", 0.004, 0.0),
        ("system_time", "system_time", 0.004, 0.0),
        ("global_time", "global_time", 0.05, 0.0),
    ],
)
def test_depth_delay_needs_stamps_of_one_clock_of_capture(
    colour: str, depth: str, delay: float, expected: float
) -> None:
    def image(stamp: float, clock: str) -> SimpleNamespace:
        domain = getattr(rs.timestamp_domain, clock)
        return SimpleNamespace(get_timestamp=lambda: 1000 * stamp, get_frame_timestamp_domain=lambda: domain)

    first, second = image(1305031102.5, colour), image(1305031102.5 + delay, depth)
    frames = SimpleNamespace(get_color_frame=lambda: first, get_depth_frame=lambda: second)
    stream = RealSenseStream("simulated", SimulatedDevice)
    assert stream._depth_delay(frames) == pytest.approx(expected, abs=1e-6)


def test_camera_runs_only_during_iteration() -> None:
    camera = SimulatedDevice()
    stream = RealSenseStream("simulated", lambda: camera)
    assert camera.sent_count == 0
    take_frames(stream, 1)
    assert camera.stopped.is_set()
    sent_count = camera.sent_count
    assert take_frames(stream, 1)[0].index == 0
    assert camera.sent_count > sent_count and camera.stopped.is_set()


def test_ctrl_c_releases_the_camera() -> None:
    camera = SimulatedDevice()
    with pytest.raises(KeyboardInterrupt):
        for frame in RealSenseStream("simulated", lambda: camera):
            if frame.index == 1:
                raise KeyboardInterrupt
    assert camera.stopped.wait(5)


def test_live_camera_is_a_live_stream_with_times_of_capture() -> None:
    camera = SimulatedDevice()
    stream = RealSenseCamera("simulated", lambda: camera)
    assert isinstance(stream, LiveStream)
    frames = iter(stream)
    arrivals = []
    for _ in range(3):
        frame = next(frames)
        captured_at = stream.captured_at(frame)
        arrivals.append(captured_at)
        stamp = time.monotonic() - time.time() + frame.stamp  # of the simulated clock, which is that of the computer
        assert captured_at == pytest.approx(stamp, abs=0.01) and captured_at <= time.monotonic()
    stream.stop()
    assert list(frames) == [] and camera.stopped.is_set()
    assert arrivals == sorted(arrivals)


@pytest.mark.parametrize("clock_restarts", [False, True])
def test_camera_continues_after_it_was_unplugged(monkeypatch: pytest.MonkeyPatch, clock_restarts: bool) -> None:
    """The camera is missing at first, then there again, in one case with a clock that starts at zero."""
    monkeypatch.setattr("v3d_torch.datasets.realsense.realsense_camera._RETRY_INTERVAL", 0.05)
    first, second = SimulatedDevice(), SimulatedDevice()
    if clock_restarts:
        second.first_stamp = 0.0
    attempts: list[bool] = []

    def open_device() -> SimulatedDevice:
        if not first.unplugged.is_set():
            return first
        attempts.append(True)
        if len(attempts) < 3:
            raise InputError("no camera is connected")
        return second

    frames = iter(RealSenseCamera("simulated", open_device))
    before = [next(frames) for _ in range(3)]
    unplugged_at = time.monotonic()
    first.unplugged.set()
    after = [next(frames) for _ in range(3)]
    missing = time.monotonic() - unplugged_at
    frames.close()  # type: ignore[attr-defined]
    assert len(attempts) == 3 and first.stopped.is_set() and second.stopped.is_set()
    assert [frame.index for frame in (*before, *after)] == list(range(6))
    stamps = [frame.stamp for frame in (*before, *after)]
    assert stamps == sorted(set(stamps))
    assert 0.1 < after[0].stamp - before[-1].stamp < missing + 0.5


def test_camera_that_cannot_be_opened_or_started_again_is_tried_at_intervals(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """librealsense first loses the camera while it is opened; then another program uses it for a second."""
    monkeypatch.setattr("v3d_torch.datasets.realsense.realsense_camera._RETRY_INTERVAL", 0.2)
    first, second = SimulatedDevice(), SimulatedDevice()
    attempts: list[float] = []

    def start() -> None:
        if time.monotonic() < attempts[0] + 1:
            raise InputError("simulated: cannot be started")
        SimulatedDevice.start(second)

    def open_device() -> SimulatedDevice:
        if not first.unplugged.is_set():
            return first
        attempts.append(time.monotonic())
        if len(attempts) == 1:
            raise RuntimeError("the device was removed")
        return second

    monkeypatch.setattr(second, "start", start)
    frames = iter(RealSenseCamera("simulated", open_device))
    next(frames)
    first.unplugged.set()
    next(frames)
    frames.close()  # type: ignore[attr-defined]
    assert second.stopped.is_set() and 2 < len(attempts) < 8
    assert caplog.text.count("cannot be started") == len(attempts) - 2


def test_other_camera_after_an_interruption_is_an_input_error() -> None:
    first, second = SimulatedDevice(), SimulatedDevice()
    second.serial = "2"
    frames = iter(RealSenseCamera("simulated", lambda: second if first.unplugged.is_set() else first))
    next(frames)
    first.unplugged.set()
    with pytest.raises(InputError, match="simulated: another camera was plugged in, 2; start again to use it"):
        list(frames)


def test_unplugged_camera_is_tracked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole system, from the device to the pose."""
    monkeypatch.setattr("v3d_torch.datasets.realsense.realsense_camera._RETRY_INTERVAL", 0.05)
    first, second = SimulatedDevice(scale=5, still=True), SimulatedDevice(scale=5, still=True)
    stream = RealSenseCamera("simulated", lambda: second if first.unplugged.is_set() else first)
    results = []
    with closing(iter(LiveSLAM(stream, V3DSLAM(stream.camera, NoSegmentation())))) as live:
        for result in live:
            results.append(result)
            if len(results) == 3:
                first.unplugged.set()
            if second.sent_count and len(results) >= 6:
                break
    assert second.stopped.is_set()
    assert all(result.status is TrackingStatus.TRACKED for result in results)
    assert results[-1].T_wc[:3, 3].norm() < 0.01


def test_first_live_frame_has_the_gravity_of_the_accelerometer() -> None:
    """The camera is tilted down by 30 degrees: an accelerometer at rest measures the opposite of gravity."""
    up = np.array([0.0, -np.cos(np.pi / 6), -np.sin(np.pi / 6)])
    device = SimulatedDevice(accelerations=9.8 * up + np.random.default_rng(0).normal(0, 0.2, (50, 3)))
    first, second = take_frames(RealSenseCamera("simulated", lambda: device), 2)
    assert float(first.gravity @ torch.from_numpy(-up)) > np.cos(np.radians(1)) and second.gravity is None
    (frame,) = take_frames(RealSenseCamera("simulated", SimulatedDevice), 1)
    assert frame.gravity is None


def test_silent_camera_is_an_input_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v3d_torch.datasets.realsense.realsense_stream._SILENCE_TIMEOUT", 0.3)
    camera = SimulatedDevice()
    monkeypatch.setattr(camera, "wait", lambda milliseconds: None)
    with pytest.raises(InputError, match=r"^simulated: sends no images; plug the camera into a USB 3 port$"):
        next(iter(RealSenseStream("simulated", lambda: camera)))
    assert camera.stopped.is_set()


def test_error_without_a_message_is_an_interruption(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = SimulatedDevice(), SimulatedDevice()
    frames = iter(RealSenseCamera("simulated", lambda: second if first.stopped.is_set() else first))
    next(frames)
    monkeypatch.setattr(first, "wait", Mock(side_effect=RuntimeError))
    next(frames)
    frames.close()  # type: ignore[attr-defined]
    assert "simulated: the camera is interrupted, waiting for it (RuntimeError)" in caplog.text


def test_device_that_fails_without_a_message_is_an_input_error() -> None:
    config, pipeline = Mock(resolve=Mock(side_effect=RuntimeError)), rs.pipeline()
    with pytest.raises(InputError, match=r"^simulated: no camera is connected \(RuntimeError\)$"):
        PipelineDevice("simulated", pipeline, config, "no camera is connected")
    config = MagicMock(**{"resolve.return_value.get_device.return_value.is_playback.return_value": False})
    device = PipelineDevice("simulated", pipeline, config, "no camera is connected")
    device._pipeline = Mock(start=Mock(side_effect=RuntimeError))
    with pytest.raises(InputError, match=r"^simulated: cannot be started \(RuntimeError\); close other programs"):
        device.start()


def test_camera_of_another_size_is_an_input_error() -> None:
    stream = RealSenseStream("simulated", SimulatedDevice, "tum_fr3")
    with pytest.raises(InputError, match=r"simulated: sends 64x48 pixels, --camera has 640x480; remove --camera"):
        take_frames(stream, 1)


@pytest.mark.parametrize("name", ["camera.yaml", "K.txt"])
def test_camera_in_a_folder_named_like_the_stream_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / "simulated").mkdir()
    text = CAMERA_YAML if name == "camera.yaml" else "30 31 15.5 11.5 1000 32 24"
    (tmp_path / "simulated" / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    stream = RealSenseStream("simulated", SimulatedDevice)
    assert stream.camera == PinholeCamera(*COLOUR_K, WIDTH, HEIGHT, depth_scale=1000)


def test_given_camera_has_the_depth_scale_of_the_device_unless_it_states_one() -> None:
    given = PinholeCamera(*COLOUR_K, WIDTH, HEIGHT)
    for stated, depth_scale in ((None, 1000), (5000, 5000)):
        stream = RealSenseStream("simulated", SimulatedDevice, replace(given, depth_scale=stated))
        assert stream.camera == replace(given, depth_scale=depth_scale)
        (frame,) = take_frames(stream, 1)
        assert float(frame.depth.max()) == pytest.approx(2000 / depth_scale)


def test_camera_file_without_a_size_has_that_of_the_device(tmp_path: Path) -> None:
    file = tmp_path / "K.txt"
    file.write_text("50 0 31\n0 51 24\n0 0 1\n")
    stream = RealSenseStream("simulated", SimulatedDevice, file)
    assert stream.camera == PinholeCamera(*COLOUR_K, WIDTH, HEIGHT, depth_scale=1000)
    assert len(take_frames(stream, 1)) == 1


@pytest.mark.parametrize(
    ("name", "label"), [("realsense", "realsense"), ("realsense:", "realsense"), ("realsense:123", "realsense_123")]
)
def test_missing_camera_is_an_input_error(name: str, label: str) -> None:
    if rs.context().query_devices().size():
        pytest.skip("a camera is connected")
    with pytest.raises(InputError, match=f"^{label}: no camera is connected; plug it into a USB 3 port$"):
        open_source(name)
    with pytest.raises(InputError, match="is a live camera, which does not support --depth-topic; remove this option"):
        open_source(name, options=SourceOptions(depth_topic="/a"))


@pytest.mark.parametrize(("fps", "requested"), [(None, 30), (29.97, 30), (0.4, 1)])
def test_frame_rate_is_requested(monkeypatch: pytest.MonkeyPatch, fps: float | None, requested: int) -> None:
    """A rate of 0 would be any rate to librealsense."""
    library = MagicMock()
    library.context.return_value.query_devices.return_value = [MagicMock()]
    library.config.return_value.resolve.side_effect = RuntimeError("Couldn't resolve requests")
    monkeypatch.setattr("v3d_torch.datasets.realsense.device.import_librealsense", lambda name: library)
    with pytest.raises(InputError, match=rf"has no colour and depth streams at 640x480 and {requested} Hz; set --fps"):
        open_live_device("realsense", "", fps)
    assert [call.args[-1] for call in library.config.return_value.enable_stream.call_args_list] == [requested] * 2


def test_path_with_the_name_of_a_camera_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "realsense").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^realsense: is a path and the name of a camera; pass \./realsense or real"):
        open_source("realsense")


def test_missing_pyrealsense2_is_an_input_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(InputError, match=r"^realsense: RealSense needs pyrealsense2 .*; run pip install pyrealsense2$"):
        open_source("realsense:")


def test_missing_libusb_is_an_input_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cause = "libusb-1.0.so.0: cannot open shared object file: No such file or directory"
    (tmp_path / "pyrealsense2.py").write_text(f"raise ImportError({cause!r})")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    with pytest.raises(InputError, match=r"^realsense: .*libusb-1.0.so.0: .*run apt install libusb-1.0-0$"):
        open_source("realsense:")


def test_record_command_saves_frames_until_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole command runs; only the camera is simulated."""
    camera = SimulatedDevice()
    requests: list[tuple[object, ...]] = []
    monkeypatch.setattr(OPEN_LIVE_DEVICE, lambda *request: (requests.append(request), camera)[1])

    def interrupt() -> None:
        depth = tmp_path / "out" / "depth"
        try:
            wait_until(lambda: len(list(depth.glob("[0-9]*"))) >= 4, 60, "four frames were recorded")
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    done = CliRunner().invoke(record.app, ["--out", str(tmp_path / "out"), "--fps", "15"])
    assert done.exit_code == 0, done.output
    assert camera.stopped.is_set()
    assert set(requests) == {("realsense", "", 15.0)}
    saved = load_sequence(str(tmp_path / "out"))
    assert len(saved) >= 4 and f"{len(saved)} frames" in done.output
    assert saved.camera == PinholeCamera(*COLOUR_K, WIDTH, HEIGHT, depth_scale=1000)
    for frame in saved:
        number = round((frame.stamp - camera.first_stamp / 1000) * FPS)
        assert np.array_equal(as_rgb(frame.image), colour_of(number, WIDTH, HEIGHT))
        assert float(frame.depth[0, 24, 38]) == pytest.approx(1 - number / 1000)


def test_run_command_on_a_live_camera_ends_with_ctrl_c_and_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OPEN_LIVE_DEVICE, lambda *request: SimulatedDevice(scale=5, still=True))
    out = tmp_path / "out"

    def interrupt() -> None:
        log = out / "run.log"
        try:
            wait_until(lambda: log.exists() and log.read_text().count("frame") >= 4, 60, "four frames were processed")
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    arguments = ["--seq", "realsense:", "--segmenter", "none", "--out", str(out), "--set", "threads=1"]
    done = CliRunner().invoke(run.app, arguments)
    assert done.exit_code == 0, done.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["sequence"], metrics["failure"]) == ("realsense", None)
    assert metrics["frames"] == metrics["processed"] + metrics["dropped"]
    assert metrics["processed"] == metrics["tracked"] >= 3
    assert 0 <= metrics["latency"]["median"] <= metrics["latency"]["p95"] <= metrics["latency"]["max"]
    assert "latency" in done.output and "dropped" in done.output
    assert len((out / "trajectory.txt").read_text().splitlines()) == metrics["processed"]


# --- recordings


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("realsense") / "take.db3"
    camera = SimulatedDevice(record_to=path)
    camera.start()
    wait_until(lambda: camera.sent_count >= 15, 60, "fifteen frames were sent")
    camera.stop()
    return path


def test_recording_yields_all_frames_at_any_speed(recording: Path) -> None:
    stream = open_source(str(recording))
    assert isinstance(stream, RealSenseStream)
    assert (stream.name, stream.groundtruth) == ("take", None)
    assert stream.camera == PinholeCamera(*COLOUR_K, WIDTH, HEIGHT, depth_scale=1000)
    runs = []
    for pause in (0.0, 0.1):
        numbers = []
        for frame in stream:
            (number,) = (n for n in range(20) if np.array_equal(as_rgb(frame.image), colour_of(n, WIDTH, HEIGHT)))
            assert float(frame.depth[0, 24, 38]) == pytest.approx(1 - number / 1000)
            numbers.append(number)
            time.sleep(pause)
        runs.append(numbers)
    assert runs[0] == runs[1] == list(range(runs[0][0], runs[0][-1] + 1))
    assert len(runs[0]) >= 10


def test_name_in_a_suggested_command_is_quoted(recording: Path, tmp_path: Path) -> None:
    path = shutil.copyfile(recording, tmp_path / "take 1.db3")
    with pytest.raises(InputError, match=f"with v3d-torch record --seq '{path}' --out FOLDER$"):
        load_sequence(path)


def test_recording_is_a_stream_not_a_sequence(recording: Path) -> None:
    with pytest.raises(InputError, match=r"take.db3: is a stream, .*with v3d-torch record --seq"):
        load_sequence(str(recording))


def test_truncated_recording_is_an_input_error(recording: Path, tmp_path: Path) -> None:
    truncated = tmp_path / "take.db3"
    truncated.write_bytes(recording.read_bytes()[:5000])
    with pytest.raises(InputError, match=rf"{truncated}: ") as caught:
        list(open_source(str(truncated)))
    assert "\n" not in str(caught.value)


# --- calibration


def camera_with(intrinsics: Any, depth_unit: float = 0.001) -> PinholeCamera:
    device = SimulatedDevice()
    device.intrinsics, device.depth_unit = intrinsics, depth_unit
    return RealSenseStream("simulated", lambda: device).camera


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("brown_conrady", (-0.056, 0.066, -0.0007, 0.0003, -0.0217)),  # of a D455
        ("inverse_brown_conrady", (-0.056, 0.066, -0.0007, 0.0003, -0.0217)),
        ("kannala_brandt4", (-0.0057, 0.0119, -0.0064, 0.0009, 0.0)),  # of a T265
        ("kannala_brandt4", (0.0, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_convention_distortion_is_that_of_librealsense(model: str, coefficients: tuple[float, ...]) -> None:
    """Pixels back-project to the same rays as in librealsense."""
    intrinsics = make_intrinsics(COLOUR_K, coefficients, model)
    camera = camera_with(intrinsics)
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(50, 2, dtype=torch.float64, generator=generator) * torch.tensor([WIDTH - 1, HEIGHT - 1])
    rays = camera.back_project(camera.undistort(pixels), torch.ones(50, dtype=torch.float64))
    expected = [rs.rs2_deproject_pixel_to_point(intrinsics, uv, 1.0) for uv in pixels.tolist()]
    torch.testing.assert_close(rays, torch.tensor(expected, dtype=torch.float64), atol=2e-5, rtol=0)
    assert (camera.undistort(pixels) - pixels).abs().max() > 0.4


def test_unsupported_distortion_model_is_rejected_unless_it_is_zero() -> None:
    with pytest.raises(InputError, match="simulated: has the unsupported distortion model ftheta; pass --camera"):
        camera_with(make_intrinsics(COLOUR_K, (0.1, 0, 0, 0, 0), "ftheta"))
    assert camera_with(make_intrinsics(COLOUR_K, model="ftheta")).distortion == (0, 0, 0, 0, 0)


def test_depth_unit_of_the_device_sets_the_depth_scale() -> None:
    assert camera_with(make_intrinsics(COLOUR_K), depth_unit=float(np.float32(0.0001))).depth_scale == 10000


def test_other_camera_at_the_start_of_the_stream_is_an_input_error() -> None:
    """Its images do not fit the calibration, which is that of the first one."""
    devices = [SimulatedDevice(), SimulatedDevice()]
    devices[1].serial = "2"
    stream = RealSenseCamera("simulated", lambda: devices.pop(0))
    with pytest.raises(InputError, match="simulated: another camera was plugged in, 2; start again to use it"):
        next(iter(stream))


def test_interrupted_camera_is_opened_again_by_its_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """With two cameras connected, unplugging the one in use would otherwise open the other."""
    monkeypatch.setattr("v3d_torch.datasets.realsense.realsense_camera._RETRY_INTERVAL", 0.05)
    asked, devices = [], [SimulatedDevice(), SimulatedDevice()]

    def open_device(name: str, serial: str, fps: float | None) -> SimulatedDevice:
        asked.append(serial)
        return devices[len(asked) > 2]

    monkeypatch.setattr(OPEN_LIVE_DEVICE, open_device)
    with closing(iter(open_realsense_camera("realsense:"))) as frames:  # type: ignore[type-var]
        next(frames)
        devices[0].unplugged.set()
        next(frames)
    assert asked == ["", "", devices[0].serial]
