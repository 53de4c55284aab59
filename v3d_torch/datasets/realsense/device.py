"""RealSense cameras and recordings as sources of frame sets, run by a librealsense pipeline."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.realsense.accelerometer import measure_accelerations
from v3d_torch.datasets.realsense.camera import import_librealsense
from v3d_torch.errors import InputError
from v3d_torch.io.text import first_line

_SIZE = (640, 480)
"""Width and height of the images of a live camera, pixels: the resolution for which the defaults are tuned."""
_FPS = 30
"""Default frame rate of a live camera, Hz: the highest that its depth and colour streams share."""


class Device(Protocol):
    """Source of frame sets, each with a colour and a depth image.

    Attributes:
        intrinsics: ``rs.intrinsics`` of the colour stream.
        depth_unit: Length of one unit of depth, metres.
        serial: Serial number of the camera; empty for a file.
    """

    intrinsics: Any
    depth_unit: float
    serial: str

    def measure_accelerations(self) -> NDArray[np.float64]:
        """Measure accelerations for a short time. Call this before `start`.

        Returns:
            Accelerations in the frame of the colour camera, m/s^2, shape :math:`(N, 3)`; N = 0 without accelerometer.
        """

    def start(self) -> None:
        """Start streaming; a recording starts from its beginning."""

    def wait(self, milliseconds: int) -> Any | None:
        """Wait for the next frame set; return None on timeout."""

    def is_over(self) -> bool:
        """Check whether the source has ended and will send no more frames."""

    def is_connected(self) -> bool:
        """Check whether the camera is connected; always True for a file."""

    def stop(self) -> None:
        """Stop streaming and release the camera or file."""


class PipelineDevice:
    """`Device` on top of an ``rs.pipeline``.

    Args:
        source: Name of the camera or path of the file, for error messages.
        pipeline: A new ``rs.pipeline``.
        config: The ``rs.config`` with the streams to run.
        failure: Cause and fix to report if the configuration cannot be resolved.

    Raises:
        InputError: If the configuration cannot be resolved.
    """

    def __init__(self, source: str, pipeline: Any, config: Any, failure: str) -> None:
        rs = import_librealsense(source)
        try:
            profile = config.resolve(rs.pipeline_wrapper(pipeline))
        except RuntimeError as error:
            raise InputError(f"{source}: {failure} ({first_line(error)})") from error
        device = profile.get_device()
        colour = profile.get_stream(rs.stream.color)
        self.intrinsics = colour.as_video_stream_profile().intrinsics
        self.depth_unit: float = device.first_depth_sensor().get_depth_scale()
        self._source = source
        self._device = device
        self._colour = colour
        self._pipeline = pipeline
        self._config = config
        self._playback = device.as_playback() if device.is_playback() else None
        self.serial: str = "" if self._playback is not None else device.get_info(rs.camera_info.serial_number)
        self._stopped = rs.playback_status.stopped

    def measure_accelerations(self) -> NDArray[np.float64]:
        """Measure the accelerations of the camera for a short time, m/s^2, see the module `accelerometer`."""
        return measure_accelerations(self._source, self._device, self._colour)

    def start(self) -> None:
        """Start the camera, or play the file from its beginning.

        Raises:
            InputError: If the camera cannot be started, for example because another program uses it.
        """
        if self._playback is None:
            try:
                self._pipeline.start(self._config)
            except RuntimeError as error:
                raise InputError(
                    f"{self._source}: cannot be started ({first_line(error)}); close other programs that use the camera"
                ) from error
            return
        self._playback.set_real_time(False)  # play as fast as the frames are consumed
        # A file starts to play when its first sensor is opened, and the second sensor would miss the beginning, so
        # pause until both are open. resume() blocks until frames are consumed, so it needs its own thread.
        self._playback.pause()
        self._pipeline.start(self._config)
        Thread(target=self._playback.resume, daemon=True).start()

    def wait(self, milliseconds: int) -> Any | None:
        """Wait for the next frame set; return None on timeout."""
        arrived, frames = self._pipeline.try_wait_for_frames(milliseconds)
        return frames if arrived else None

    def is_over(self) -> bool:
        """Check whether a file has been played to its end; always False for a camera."""
        return self._playback is not None and self._playback.current_status() == self._stopped

    def is_connected(self) -> bool:
        """Check whether the camera is connected; always True for a file."""
        return self._playback is not None or bool(self._device.is_connected())

    def stop(self) -> None:
        """Stop streaming and release the camera or file."""
        with suppress(RuntimeError):  # a camera that was unplugged has already stopped
            self._pipeline.stop()


def open_live_device(name: str, serial: str, fps: float | None) -> PipelineDevice:
    """Open a connected camera.

    Args:
        name: Name of the camera, for error messages.
        serial: Serial number of the camera; empty for any camera.
        fps: Frame rate to request, Hz; None for 30.

    Raises:
        InputError: If the camera is not connected or does not support the frame rate.
    """
    rs = import_librealsense(name)
    context = rs.context()
    connected = [device.get_info(rs.camera_info.serial_number) for device in context.query_devices()]
    if not connected:
        raise InputError(f"{name}: no camera is connected; plug it into a USB 3 port")
    if serial and serial not in connected:
        raise InputError(f"{name}: no camera with this serial number is connected; choose from {', '.join(connected)}")
    config = rs.config()
    if serial:
        config.enable_device(serial)
    rate = max(round(fps or _FPS), 1)  # to librealsense, 0 is any rate
    config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, rate)
    config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, rate)
    failure = f"has no colour and depth streams at {_SIZE[0]}x{_SIZE[1]} and {rate} Hz; set --fps to 30, 15 or 6"
    return PipelineDevice(name, rs.pipeline(context), config, failure)


def open_recorded_device(path: Path) -> PipelineDevice:
    """Open a file that RealSense software recorded.

    Raises:
        InputError: If the file is damaged, or has no colour or no depth stream.
    """
    rs = import_librealsense(str(path))
    config = rs.config()
    config.enable_device_from_file(str(path), repeat_playback=False)
    config.enable_stream(rs.stream.color)
    config.enable_stream(rs.stream.depth)
    failure = "is damaged or has no colour or no depth stream; record it again"
    return PipelineDevice(str(path), rs.pipeline(), config, failure)
