"""Live stream of a RealSense camera that can be unplugged and plugged in again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from threading import Event
from typing import Any

from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.gravity import gravity_direction
from v3d_torch.datasets.realsense.camera import import_librealsense
from v3d_torch.datasets.realsense.device import Device, open_live_device
from v3d_torch.datasets.realsense.realsense_stream import CapturedImages, RealSenseStream
from v3d_torch.errors import InputError
from v3d_torch.io.text import first_line
from v3d_torch.types import RGBDFrame

_LOG = logging.getLogger(__name__)

_RETRY_INTERVAL = 1.0
"""Time between two attempts to open a camera that was unplugged, seconds."""

_MAX_CLOCK_JUMP = 0.5
"""Maximum difference between the times that elapse in the clocks of camera and computer while the camera is unplugged,
seconds. If it is larger, the clock of the camera was reset."""


class RealSenseCamera(RealSenseStream):
    """`LiveStream` of a connected camera.

    After an interruption, such as an unplugged cable, the iteration continues as soon as the same camera is connected
    again; stamps include the time that has passed. The first frame has the direction of gravity if the camera has an
    accelerometer.

    Args:
        name: Name of the stream, for tables and error messages.
        open_device: Function that opens the camera without starting it.
        camera: Camera chosen by the user; None for the calibration of the device.
        reopen_device: Function that opens the camera with a serial number, after an interruption; None for
            ``open_device``. It is needed if several cameras can be connected.

    Raises:
        InputError: If ``open_device`` raises it, or the distortion model is not supported.
    """

    def __init__(
        self,
        name: str,
        open_device: Callable[[], Device],
        camera: CameraChoice = None,
        reopen_device: Callable[[str], Device] | None = None,
    ) -> None:
        super().__init__(name, open_device, camera)
        self._reopen_device = reopen_device or (lambda _: open_device())
        self._stopped = Event()
        self._captured_at = 0.0

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Start the camera and yield its frames.

        Raises:
            InputError: If the camera sends no first frame, sends an unsupported format, or is replaced by another
                camera.
        """
        self._stopped.clear()
        first = self._open_device()
        self._check_serial(first)
        gravity = gravity_direction(first.measure_accelerations(), self.name)
        device: Device | None = first
        index, stamp, arrival = 0, 0.0, 0.0
        while device is not None:
            shift: float | None = None if index else 0.0
            first_index = index
            with closing(self._images(device)) as images:
                while (captured := self._next(images, is_first=index == 0)) is not None:
                    now = time.monotonic()
                    if shift is None:
                        shift = _clock_shift(stamp, stamp + now - arrival, captured.stamp)
                    stamp, arrival = captured.stamp + shift, now
                    self._captured_at = _capture_time(self.name, captured.stamp, captured.colour, now)
                    frame = self._convert_frame(index, stamp, captured)
                    yield frame if index else replace(frame, gravity=gravity)
                    index += 1
            if index == first_index:  # such as a camera that another program uses: it is there, but cannot be started
                self._stopped.wait(_RETRY_INTERVAL)
            device = self._reopen()

    def captured_at(self, frame: RGBDFrame) -> float:
        """Return the time of capture of the newest frame in the clock of the computer, seconds.

        If the stamps of the camera cannot be converted to this clock, it is the time of arrival.
        """
        return self._captured_at

    def stop(self) -> None:
        """End the iteration within a fraction of a second; can be called from another thread."""
        self._stopped.set()

    def _is_stopped(self) -> bool:
        return self._stopped.is_set()

    def _next(self, images: Generator[CapturedImages, None, None], *, is_first: bool) -> CapturedImages | None:
        """Return the next images; None if the stream was stopped or the camera was unplugged, which is logged."""
        try:
            return next(images, None)
        except (InputError, RuntimeError) as error:
            if is_first:
                raise
            _LOG.warning("%s: the camera is interrupted, waiting for it (%s)", self.name, first_line(error))
            return None

    def _reopen(self) -> Device | None:
        """Wait for a camera that was unplugged; None if the stream is stopped before."""
        while not self._is_stopped():
            try:
                device = self._reopen_device(self._serial)
            except (InputError, RuntimeError):  # librealsense raises the second one if the camera goes away again
                self._stopped.wait(_RETRY_INTERVAL)
                continue
            self._check_serial(device)
            return device
        return None

    def _check_serial(self, device: Device) -> None:
        """Raise InputError if a device is not the one that gave the calibration."""
        if device.serial != self._serial:
            raise InputError(f"{self.name}: another camera was plugged in, {device.serial}; start again to use it")


def _clock_shift(previous: float, expected: float, stamp: float) -> float:
    """Difference to add to the stamps of a camera after an interruption, seconds.

    Args:
        previous: Last stamp before the interruption.
        expected: Last stamp plus the time that has passed on the computer.
        stamp: First stamp after the interruption.
    """
    continues = stamp > previous and abs(stamp - expected) <= _MAX_CLOCK_JUMP
    return 0.0 if continues else expected - stamp


def _capture_time(name: str, stamp: float, colour: Any, arrival: float) -> float:
    """Time of capture in the clock of the computer, given the times of capture and arrival of an image."""
    domain = import_librealsense(name).timestamp_domain
    is_own_clock = colour.get_frame_timestamp_domain() == domain.hardware_clock
    return arrival if is_own_clock else min(stamp + time.monotonic() - time.time(), arrival)


def open_realsense_camera(name: str, camera: CameraChoice = None, *, fps: float | None = None) -> RealSenseCamera:
    """Open a connected camera as a live stream.

    Args:
        name: ``realsense:`` for any camera, ``realsense:SERIAL`` for one of several.
        camera: Camera chosen by the user; None for the calibration of the device.
        fps: Frame rate to request, Hz; None for the default.

    Raises:
        InputError: If the camera cannot be opened, see `open_live_device`.
    """
    serial = name.partition(":")[2]
    label = f"realsense_{serial}" if serial else "realsense"  # without a colon: valid as a folder name

    def open_device(serial: str) -> Device:
        return open_live_device(label, serial, fps)

    return RealSenseCamera(label, partial(open_device, serial), camera, open_device)
