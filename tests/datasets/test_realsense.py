"""RealSense: the live path on a camera that librealsense simulates, files that it records, and cameras' lenses."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.tiny_images import as_rgb, colour_of
from numpy.typing import NDArray
from typer.testing import CliRunner

from v3d_torch.cli import record, run
from v3d_torch.datasets import RGBDSequence, RGBDStream, SourceOptions, load_sequence, open_source, realsense_device
from v3d_torch.datasets.realsense import RealSenseStream
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera

rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)

WIDTH, HEIGHT = 64, 48
FPS = 30
COLOUR_K, DEPTH_K = (50.0, 51.0, 31.0, 24.0), (60.0, 60.0, 32.0, 23.5)
BASELINE = 0.1
"""From the depth camera to the colour camera, metres to the left."""


class Simulated:
    """A `Device`: librealsense's `software_device` with a thread that takes frames 0, 1, 2 ... as long as it runs.

    Args:
        record_to: file.
        enlarged: how many pixels make one of the small images.
        still: whether frame 0 is taken again and again.
    """

    depth_unit = 0.001

    def __init__(self, record_to: Path | None = None, *, enlarged: int = 1, still: bool = False) -> None:
        self._enlarged, self._still = enlarged, still
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Simulated")
        self.device.register_info(rs.camera_info.serial_number, "1")
        self._sensors = {kind: self.device.add_sensor(kind) for kind in ("Depth", "Color")}
        self._sensors["Depth"].add_read_only_option(rs.option.depth_units, 0.001)
        self.depth = self._profile("Depth", 1, rs.stream.depth, rs.format.z16, DEPTH_K)
        self.colour = self._profile("Color", 2, rs.stream.color, rs.format.rgb8, COLOUR_K)
        pose = rs.extrinsics()
        pose.rotation, pose.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [BASELINE, 0, 0]
        self.depth.register_extrinsics_to(self.colour, pose)
        self.device.create_matcher(rs.matchers.dlr_c)
        self.intrinsics = self.colour.intrinsics
        self.first = time.time() * 1000  # the syncer expects stamps of today
        self.sent = 0
        self.stopped = threading.Event()
        self._recorder = rs.recorder(str(record_to), self.device) if record_to is not None else None

    def _profile(self, sensor: str, uid: int, kind: Any, form: Any, K: tuple[float, ...]) -> Any:
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.uid, stream.index = kind, form, uid, 0
        stream.width, stream.height = WIDTH * self._enlarged, HEIGHT * self._enlarged
        stream.fps, stream.bpp = FPS, 2 if sensor == "Depth" else 3
        stream.intrinsics = intrinsics(tuple(self._enlarged * value for value in K))
        stream.intrinsics.width, stream.intrinsics.height = stream.width, stream.height
        return self._sensors[sensor].add_video_stream(stream).as_video_stream_profile()

    def start(self) -> None:
        self.stopped.clear()
        self._syncer = rs.syncer(100)
        self._running = (self._recorder or self.device).query_sensors()
        for sensor in self._running:
            sensor.open(sensor.get_stream_profiles()[0])
            sensor.start(self._syncer)
        self._thread = threading.Thread(target=self._feed)
        self._thread.start()

    def wait(self, milliseconds: int) -> Any | None:
        arrived, frames = self._syncer.try_wait_for_frames(milliseconds)
        return frames if arrived else None

    def is_over(self) -> bool:
        return False

    def stop(self) -> None:
        self.stopped.set()
        self._thread.join()
        for sensor in self._running:
            sensor.stop()
            sensor.close()

    def _feed(self) -> None:
        while not self.stopped.wait(1 / FPS):
            number, larger = 0 if self._still else self.sent, {"fx": self._enlarged, "fy": self._enlarged}
            depth, colour = depth_image(number), colour_of(number, WIDTH, HEIGHT)
            self._send("Depth", self.depth, cv2.resize(depth, None, **larger, interpolation=cv2.INTER_NEAREST))
            self._send("Color", self.colour, cv2.resize(colour, None, **larger, interpolation=cv2.INTER_CUBIC))
            self.sent += 1

    def _send(self, sensor: str, profile: Any, pixels: NDArray[Any]) -> None:
        frame = rs.software_video_frame()
        frame.pixels, frame.profile = pixels, profile
        frame.bpp = pixels.nbytes // (pixels.shape[0] * pixels.shape[1])
        frame.stride = frame.bpp * pixels.shape[1]
        frame.timestamp, frame.domain = self.first + self.sent * 1000 / FPS, rs.timestamp_domain.global_time
        frame.frame_number = self.sent
        if sensor == "Depth":
            frame.depth_units = 0.001
        self._sensors[sensor].on_video_frame(frame)


def intrinsics(K: tuple[float, ...], lens: tuple[float, ...] = (0.0,) * 5, model: str = "brown_conrady") -> Any:
    made = rs.intrinsics()
    made.width, made.height, made.coeffs, made.model = WIDTH, HEIGHT, list(lens), getattr(rs.distortion, model)
    made.fx, made.fy, made.ppx, made.ppy = K
    return made


def depth_image(number: int) -> NDArray[np.uint16]:
    """A wall at 2 m with a board at 1 m in its middle, which comes a millimetre nearer with every frame."""
    units = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    units[16:32, 24:40] = 1000 - number
    return units


def taken(stream: RGBDStream, count: int) -> list[Any]:
    frames = iter(stream)
    try:
        return [next(frames) for _ in range(count)]
    finally:
        frames.close()  # type: ignore[attr-defined]


# --- live


@pytest.fixture(scope="module")
def live() -> Iterator[SimpleNamespace]:
    camera = Simulated()
    stream = RealSenseStream("simulated", lambda: camera)
    frames = taken(stream, 5)
    yield SimpleNamespace(camera=camera, stream=stream, frames=frames)


def test_live_frames(live: SimpleNamespace) -> None:
    assert isinstance(live.stream, RGBDStream) and not isinstance(live.stream, RGBDSequence)
    assert live.stream.camera == PinholeCamera(*COLOUR_K, WIDTH, HEIGHT, depth_scale=1000)
    for index, frame in enumerate(live.frames):
        assert frame.index == index
        number = round((frame.stamp - live.camera.first / 1000) * FPS)
        assert frame.stamp == pytest.approx(live.camera.first / 1000 + number / FPS, abs=1e-5)
        assert np.array_equal(as_rgb(frame.image), colour_of(number, WIDTH, HEIGHT))
        assert (frame.depth.dtype, frame.depth.shape) == (torch.float32, (1, HEIGHT, WIDTH))
        assert float(frame.depth[0, 24, 38]) == pytest.approx(1 - number / 1000)  # the depth of this very frame
    stamps = [frame.stamp for frame in live.frames]
    assert stamps == sorted(set(stamps))


def test_convention_depth_is_aligned_to_colour(live: SimpleNamespace) -> None:
    """The board's corners are where the colour camera sees them."""
    frame = live.frames[0]
    number = round((frame.stamp - live.camera.first / 1000) * FPS)
    z = 1 - number / 1000
    rows, columns = torch.nonzero((frame.depth[0] > 0.9) & (frame.depth[0] < 1.1), as_tuple=True)
    (fx, fy, cx, cy), (gx, gy, px, py) = COLOUR_K, DEPTH_K
    left, right = (fx * ((edge - px) / gx + BASELINE / z) + cx for edge in (23.5, 39.5))
    top, bottom = (fy * (edge - py) / gy + cy for edge in (15.5, 31.5))
    found = [columns.min() - 0.5, columns.max() + 0.5, rows.min() - 0.5, rows.max() + 0.5]
    assert [float(edge) for edge in found] == pytest.approx([left, right, top, bottom], abs=1)


def test_frames_stay_as_they_are(live: SimpleNamespace) -> None:
    """librealsense uses a frame's memory again: what was given out must not change under the user's hands."""
    assert len({frame.image.numpy().tobytes() for frame in live.frames}) == len(live.frames)


def test_the_camera_runs_only_while_frames_are_taken() -> None:
    camera = Simulated()
    stream = RealSenseStream("simulated", lambda: camera)
    assert camera.sent == 0
    taken(stream, 1)
    assert camera.stopped.is_set()
    sent = camera.sent
    assert taken(stream, 1)[0].index == 0
    assert camera.sent > sent and camera.stopped.is_set()


def test_ctrl_c_lets_go_of_the_camera() -> None:
    camera = Simulated()
    with pytest.raises(KeyboardInterrupt):
        for frame in RealSenseStream("simulated", lambda: camera):
            if frame.index == 1:
                raise KeyboardInterrupt
    assert camera.stopped.wait(5)


def test_a_camera_that_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v3d_torch.datasets.realsense._PATIENCE", 0.3)
    camera = Simulated()
    monkeypatch.setattr(camera, "wait", lambda milliseconds: None)
    with pytest.raises(InputError, match="simulated: sends no images; plug"):
        next(iter(RealSenseStream("simulated", lambda: camera)))
    assert camera.stopped.is_set()


def test_a_camera_file_of_another_size() -> None:
    stream = RealSenseStream("simulated", Simulated, "tum_fr3")
    with pytest.raises(InputError, match=r"simulated: sends 64x48 pixels, --camera has 640x480"):
        taken(stream, 1)


@pytest.mark.parametrize(
    ("name", "called"), [("realsense", "realsense"), ("realsense:", "realsense"), ("realsense:123", "realsense_123")]
)
def test_no_camera_is_connected(name: str, called: str) -> None:
    if rs.context().query_devices().size():
        pytest.skip("there is a camera")
    start = time.monotonic()
    with pytest.raises(InputError, match=f"^{called}: no such camera is connected, there is none; plug it"):
        open_source(name)
    assert time.monotonic() - start < 5
    with pytest.raises(InputError, match="is a live camera, which does not support --depth-topic"):
        open_source(name, options=SourceOptions(depth_topic="/a"))


def test_without_pyrealsense2(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(InputError, match=r"^realsense: RealSense needs pyrealsense2 .*; pip install pyrealsense2$"):
        open_source("realsense:")


def test_without_libusb_which_pip_does_not_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    why = "libusb-1.0.so.0: cannot open shared object file: No such file or directory"
    (tmp_path / "pyrealsense2.py").write_text(f"raise ImportError({why!r})")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    with pytest.raises(InputError, match=r"^realsense: .*libusb-1.0.so.0: .*apt install libusb-1.0-0$"):
        open_source("realsense:")


def test_record_saves_a_live_camera_until_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command as it runs with a camera: only the camera is simulated."""
    camera = Simulated()
    asked: list[tuple[object, ...]] = []
    monkeypatch.setattr(realsense_device, "live", lambda *wanted: (asked.append(wanted), camera)[1])

    def interrupt() -> None:
        while len(list((tmp_path / "out" / "depth").glob("[0-9]*"))) < 4:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    done = CliRunner().invoke(record.app, ["--out", str(tmp_path / "out"), "--fps", "15"])
    assert done.exit_code == 0, done.output
    assert camera.stopped.is_set()
    assert set(asked) == {("realsense", "", 15.0)}
    saved = load_sequence(str(tmp_path / "out"))
    assert len(saved) >= 4 and f"{len(saved)} frames" in done.output
    assert saved.camera == PinholeCamera(*COLOUR_K, WIDTH, HEIGHT, depth_scale=1000)
    for frame in saved:
        number = round((frame.stamp - camera.first / 1000) * FPS)
        assert np.array_equal(as_rgb(frame.image), colour_of(number, WIDTH, HEIGHT))
        assert float(frame.depth[0, 24, 38]) == pytest.approx(1 - number / 1000)


def test_a_live_run_ends_with_ctrl_c_and_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realsense_device, "live", lambda *wanted: Simulated(enlarged=5, still=True))
    out = tmp_path / "out"

    def interrupt() -> None:
        while not (out / "run.log").exists() or (out / "run.log").read_text().count("frame") < 4:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    arguments = ["--seq", "realsense:", "--segmenter", "none", "--out", str(out), "--set", "threads=1"]
    done = CliRunner().invoke(run.app, arguments)
    assert done.exit_code == 0, done.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["sequence"], metrics["failure"]) == ("realsense", None)
    assert metrics["frames"] == metrics["processed"] == metrics["tracked"] >= 3
    assert len((out / "trajectory.txt").read_text().splitlines()) == metrics["processed"]


# --- recorded


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("realsense") / "take.db3"
    camera = Simulated(record_to=path)
    camera.start()
    while camera.sent < 15:
        time.sleep(0.05)
    camera.stop()
    return path


def test_recorded_frames_all_come(recording: Path) -> None:
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


def test_a_recording_is_a_stream(recording: Path) -> None:
    with pytest.raises(InputError, match=r"take.db3: is a stream, .*python -m v3d_torch record --seq"):
        load_sequence(str(recording))


def test_a_broken_recording(recording: Path, tmp_path: Path) -> None:
    broken = tmp_path / "take.db3"
    broken.write_bytes(recording.read_bytes()[:5000])
    with pytest.raises(InputError, match=rf"{broken}: ") as caught:
        list(open_source(str(broken)))
    assert "\n" not in str(caught.value)


# --- lenses


def camera_with(lens: Any, depth_unit: float = 0.001) -> PinholeCamera:
    device = Simulated()
    device.intrinsics, device.depth_unit = lens, depth_unit
    return RealSenseStream("simulated", lambda: device).camera


@pytest.mark.parametrize("model", ["brown_conrady", "inverse_brown_conrady"])
def test_convention_lenses(model: str) -> None:
    """Rays of pixels are those of librealsense."""
    lens = intrinsics(COLOUR_K, (-0.056, 0.066, -0.0007, 0.0003, -0.0217), model)  # those of a D455
    camera = camera_with(lens)
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(50, 2, dtype=torch.float64, generator=generator) * torch.tensor([WIDTH - 1, HEIGHT - 1])
    rays = camera.back_project(camera.undistort(pixels), torch.ones(50, dtype=torch.float64))
    expected = [rs.rs2_deproject_pixel_to_point(lens, uv, 1.0) for uv in pixels.tolist()]
    torch.testing.assert_close(rays, torch.tensor(expected, dtype=torch.float64), atol=2e-5, rtol=0)
    assert (camera.undistort(pixels) - pixels).abs().max() > 0.4


def test_an_unknown_lens() -> None:
    with pytest.raises(InputError, match="simulated: has a lens of the kind kannala_brandt4"):
        camera_with(intrinsics(COLOUR_K, (0.1, 0, 0, 0, 0), "kannala_brandt4"))
    assert camera_with(intrinsics(COLOUR_K, model="kannala_brandt4")).distortion == (0, 0, 0, 0, 0)


def test_a_depth_unit_of_its_own() -> None:
    assert camera_with(intrinsics(COLOUR_K), depth_unit=float(np.float32(0.0001))).depth_scale == 10000
