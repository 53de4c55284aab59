"""A RealSense camera simulated by librealsense, for tests without a device."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from helpers.tiny_images import colour_of

rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)

WIDTH, HEIGHT = 64, 48
FPS = 30
COLOUR_K, DEPTH_K = (50.0, 51.0, 31.0, 24.0), (60.0, 60.0, 32.0, 23.5)
BASELINE = 0.1
"""Distance of the colour camera to the left of the depth camera, metres."""


class SimulatedDevice:
    """`Device` on top of librealsense's `software_device`, with a thread that sends frames 0, 1, 2 ... while it runs.

    Args:
        record_to: File to record to; None for no recording.
        scale: Integer factor by which the small images are enlarged.
        still: True to send frame 0 again and again.
        accelerations: Measurements of the accelerometer, m/s^2, shape (N, 3); None if there is none.
        depth_delay: Time of a depth image minus time of its colour image, seconds.
    """

    depth_unit, serial = 0.001, "1"

    def __init__(
        self,
        record_to: Path | None = None,
        *,
        scale: int = 1,
        still: bool = False,
        accelerations: NDArray[np.float64] | None = None,
        depth_delay: float = 0.0,
    ) -> None:
        self._scale, self._still = scale, still
        self._depth_delay = depth_delay
        self.accelerations = np.zeros((0, 3)) if accelerations is None else accelerations
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Simulated")
        self.device.register_info(rs.camera_info.serial_number, "1")
        self._sensors = {kind: self.device.add_sensor(kind) for kind in ("Depth", "Color")}
        self._sensors["Depth"].add_read_only_option(rs.option.depth_units, 0.001)
        self.depth = self._profile("Depth", 1, rs.stream.depth, rs.format.z16, DEPTH_K)
        self.colour = self._profile("Color", 2, rs.stream.color, rs.format.rgb8, COLOUR_K)
        extrinsics = rs.extrinsics()
        extrinsics.rotation, extrinsics.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [BASELINE, 0, 0]
        self.depth.register_extrinsics_to(self.colour, extrinsics)
        self.device.create_matcher(rs.matchers.dlr_c)
        self.intrinsics = self.colour.intrinsics
        self.first_stamp = time.time() * 1000  # milliseconds; the syncer expects current stamps
        self.sent_count = 0
        self.stopped = threading.Event()
        self.unplugged = threading.Event()
        self._recorder = rs.recorder(str(record_to), self.device) if record_to is not None else None

    def _profile(self, sensor: str, uid: int, kind: Any, stream_format: Any, K: tuple[float, ...]) -> Any:
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.uid, stream.index = kind, stream_format, uid, 0
        stream.width, stream.height = WIDTH * self._scale, HEIGHT * self._scale
        stream.fps, stream.bpp = FPS, 2 if sensor == "Depth" else 3
        stream.intrinsics = make_intrinsics(tuple(self._scale * value for value in K))
        stream.intrinsics.width, stream.intrinsics.height = stream.width, stream.height
        return self._sensors[sensor].add_video_stream(stream).as_video_stream_profile()

    def start(self) -> None:
        self.stopped.clear()
        self._syncer = rs.syncer(100)
        self._open_sensors = (self._recorder or self.device).query_sensors()
        for sensor in self._open_sensors:
            sensor.open(sensor.get_stream_profiles()[0])
            sensor.start(self._syncer)
        self._thread = threading.Thread(target=self._send_frames)
        self._thread.start()

    def wait(self, milliseconds: int) -> Any | None:
        arrived, frames = self._syncer.try_wait_for_frames(milliseconds)
        return frames if arrived else None

    def is_over(self) -> bool:
        return False

    def is_connected(self) -> bool:
        return not self.unplugged.is_set()

    def measure_accelerations(self) -> NDArray[np.float64]:
        return self.accelerations

    def stop(self) -> None:
        self.stopped.set()
        self._thread.join()
        for sensor in self._open_sensors:
            sensor.stop()
            sensor.close()

    def _send_frames(self) -> None:
        while not self.stopped.wait(1 / FPS):
            if self.unplugged.is_set():
                continue
            number = 0 if self._still else self.sent_count
            factors = {"fx": self._scale, "fy": self._scale}
            depth, colour = depth_image(number), colour_of(number, WIDTH, HEIGHT)
            self._send("Depth", self.depth, cv2.resize(depth, None, **factors, interpolation=cv2.INTER_NEAREST))
            self._send("Color", self.colour, cv2.resize(colour, None, **factors, interpolation=cv2.INTER_CUBIC))
            self.sent_count += 1

    def _send(self, sensor: str, profile: Any, pixels: NDArray[Any]) -> None:
        frame = rs.software_video_frame()
        frame.pixels, frame.profile = pixels, profile
        frame.bpp = pixels.nbytes // (pixels.shape[0] * pixels.shape[1])
        frame.stride = frame.bpp * pixels.shape[1]
        frame.timestamp, frame.domain = self.first_stamp + self.sent_count * 1000 / FPS, rs.timestamp_domain.global_time
        frame.frame_number = self.sent_count
        if sensor == "Depth":
            frame.depth_units = 0.001
            frame.timestamp += self._depth_delay * 1000
        self._sensors[sensor].on_video_frame(frame)


def make_intrinsics(
    K: tuple[float, ...], distortion: tuple[float, ...] = (0.0,) * 5, model: str = "brown_conrady"
) -> Any:
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height = WIDTH, HEIGHT
    intrinsics.coeffs, intrinsics.model = list(distortion), getattr(rs.distortion, model)
    intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = K
    return intrinsics


def depth_image(number: int) -> NDArray[np.uint16]:
    """Depth of a wall at 2 m and a board in front of it at 1 m, which approaches by a millimetre per frame."""
    units = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    units[16:32, 24:40] = 1000 - number
    return units
