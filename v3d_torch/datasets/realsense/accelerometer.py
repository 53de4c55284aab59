"""Accelerometer of RealSense cameras such as the D435i."""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.realsense.camera import import_librealsense
from v3d_torch.io.text import first_line

_LOG = logging.getLogger(__name__)

_DURATION = 0.3
"""Time for which accelerations are measured, seconds: longer than the vibration of a hand."""

_TIMEOUT = 1.0
"""Timeout of the measurement, seconds."""


def measure_accelerations(source: str, device: Any, colour: Any) -> NDArray[np.float64]:
    """Measure accelerations for a short time. The motion sensor must not be in use.

    Args:
        source: Name of the camera, for the log.
        device: ``rs.device``.
        colour: Profile of the colour stream.

    Returns:
        Accelerations in the frame of the colour camera, m/s^2, shape :math:`(N, 3)`. N = 0 without accelerometer, or if
        it cannot be read; this is logged.
    """
    rs = import_librealsense(source)
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() == rs.stream.accel:
                try:
                    rotation = np.reshape(profile.get_extrinsics_to(colour).rotation, (3, 3), order="F")
                    measured = _read(rs, sensor, profile) @ rotation.T
                    if len(measured) == 0:
                        _LOG.warning("%s: the accelerometer sends no measurements; gravity is not used", source)
                    return measured
                except RuntimeError as error:
                    reason = first_line(error)
                    _LOG.warning("%s: the accelerometer cannot be read (%s); gravity is not used", source, reason)
                    return np.zeros((0, 3))
    return np.zeros((0, 3))


def _read(rs: Any, sensor: Any, profile: Any) -> NDArray[np.float64]:
    """Read the accelerations of some tenths of a second, frame of the accelerometer, shape (N, 3)."""
    accelerations = [np.zeros((0, 3))]
    queue = rs.frame_queue(64)
    sensor.open(profile)
    try:
        sensor.start(queue)
        try:
            start, first = time.monotonic(), None
            while time.monotonic() - start < _TIMEOUT and (first is None or time.monotonic() - first < _DURATION):
                arrived, frame = queue.try_wait_for_frame(50)
                if arrived:
                    first = first or time.monotonic()
                    data = frame.as_motion_frame().get_motion_data()
                    accelerations.append(np.array([[data.x, data.y, data.z]]))
        finally:
            sensor.stop()
    finally:
        sensor.close()
    return np.concatenate(accelerations)
