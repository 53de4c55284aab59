"""Accelerometer of a simulated RealSense camera."""

from __future__ import annotations

import logging
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.simulated_realsense import COLOUR_K, make_intrinsics, rs

from v3d_torch.datasets.realsense.accelerometer import measure_accelerations


def make_device() -> tuple[Any, Any, Any, Any]:
    """Return a device with an accelerometer, its sensor, and the profiles of accelerometer and colour."""
    device = rs.software_device()
    colour_sensor, sensor = device.add_sensor("Color"), device.add_sensor("Motion")
    video = rs.video_stream()
    video.type, video.fmt, video.uid, video.index = rs.stream.color, rs.format.rgb8, 1, 0
    video.width, video.height, video.fps, video.bpp = 64, 48, 30, 3
    video.intrinsics = make_intrinsics(COLOUR_K)
    motion = rs.motion_stream()
    motion.type, motion.fmt, motion.uid, motion.index, motion.fps = rs.stream.accel, rs.format.motion_xyz32f, 2, 0, 100
    colour, accelerometer = colour_sensor.add_video_stream(video), sensor.add_motion_stream(motion)
    return device, sensor, accelerometer, colour


def test_accelerations_are_in_the_frame_of_the_colour_camera() -> None:
    device, sensor, profile, colour = make_device()
    extrinsics = rs.extrinsics()
    extrinsics.rotation, extrinsics.translation = [0, 1, 0, -1, 0, 0, 0, 0, 1], [0, 0, 0]  # columns: x becomes y
    profile.register_extrinsics_to(colour, extrinsics)
    stop = threading.Event()

    def send() -> None:
        number = 0
        while not stop.wait(0.01):
            frame = rs.software_motion_frame()
            acceleration = rs.vector()
            acceleration.x, acceleration.y, acceleration.z = 9.8, 0.5, 0.1
            frame.data = acceleration
            frame.timestamp, frame.domain = 10.0 * number, rs.timestamp_domain.hardware_clock
            frame.frame_number, frame.profile = number, profile.as_motion_stream_profile()
            sensor.on_motion_frame(frame)
            number += 1

    thread = threading.Thread(target=send)
    thread.start()
    try:
        accelerations = measure_accelerations("simulated", device, colour)
    finally:
        stop.set()
        thread.join()
    assert len(accelerations) >= 5
    np.testing.assert_allclose(accelerations, np.tile([-0.5, 9.8, 0.1], (len(accelerations), 1)), atol=1e-5)


def test_camera_without_accelerometer_has_no_accelerations() -> None:
    assert measure_accelerations("simulated", rs.software_device(), None).shape == (0, 3)


@pytest.mark.parametrize(
    ("message", "reason"), [("Device or resource busy\nmore", "Device or resource busy"), ("", "RuntimeError")]
)
def test_accelerometer_that_cannot_be_read_is_logged(
    caplog: pytest.LogCaptureFixture, message: str, reason: str
) -> None:
    _, _, profile, colour = make_device()

    class Busy:
        def get_stream_profiles(self) -> list[Any]:
            return [profile]

        def open(self, profile: Any) -> None:
            raise RuntimeError(message)

    identity = rs.extrinsics()
    identity.rotation, identity.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
    profile.register_extrinsics_to(colour, identity)
    with caplog.at_level(logging.WARNING):
        found = measure_accelerations("simulated", SimpleNamespace(query_sensors=lambda: [Busy()]), colour)
    assert found.shape == (0, 3)
    assert f"cannot be read ({reason}); gravity is not used" in caplog.text


def test_accelerometer_that_sends_nothing_is_logged(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("v3d_torch.datasets.realsense.accelerometer._TIMEOUT", 0.1)
    device, _, profile, colour = make_device()
    identity = rs.extrinsics()
    identity.rotation, identity.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
    profile.register_extrinsics_to(colour, identity)
    with caplog.at_level(logging.WARNING):
        assert measure_accelerations("simulated", device, colour).shape == (0, 3)
    assert "simulated: the accelerometer sends no measurements; gravity is not used" in caplog.text
