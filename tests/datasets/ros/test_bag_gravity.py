"""Direction of gravity from the accelerometer in a bag."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bags import DEPTH, INFO, KINDS, RGB, Kind, Message, MessageFactory
from helpers.tiny_images import HEIGHT, WIDTH, colour_of, depth_of
from scipy.spatial.transform import Rotation

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.ros import BagSequence

DOWN = np.array([0.3, 0.9, 0.1]) / np.linalg.norm([0.3, 0.9, 0.1])
"""Direction of gravity, frame of the colour camera."""


def write_bag(make: MessageFactory, path: Path, extra: list[Message], camera_frame: str = "optical") -> BagSequence:
    k, p = [30.0, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1], [28.0, 0, 15.0, 0, 0, 29.0, 11.0, 0, 0, 0, 1, 0]
    messages: list[Message] = [(INFO, 9.0, make.info(WIDTH, HEIGHT, k, [0.0] * 5, p)), *extra]
    for i in range(2):
        messages.append((RGB, 20 + i, make.image(10 + i / 10, "rgb8", colour_of(i), frame=camera_frame)))
        messages.append((DEPTH, 20 + i, make.image(10 + i / 10, "16UC1", depth_of(i), frame=camera_frame)))
    sequence = load_sequence(str(make.write(path / "take", messages)))
    assert isinstance(sequence, BagSequence)
    return sequence


def measurements(
    make: MessageFactory, acceleration: np.ndarray, frame: str = "optical", topic: str = "/imu"
) -> list[Message]:
    """Half a second of noisy measurements before the first image, and others long before and after it."""
    rng = np.random.default_rng(0)
    still = [
        (topic, 15 + n / 100, make.imu(9.5 + n / 100, acceleration + rng.normal(0, 0.1, 3), frame)) for n in range(55)
    ]
    other = -acceleration
    return [(topic, 1.0, make.imu(5.0, other, frame)), *still, (topic, 19.0, make.imu(15.0, other, frame))]


@pytest.mark.parametrize("kind", KINDS)
def test_first_frame_has_the_gravity_in_the_frame_of_the_camera(kind: Kind, tmp_path: Path) -> None:
    """The accelerometer is mounted with an offset and rotated: /tf_static has its orientation, in two steps."""
    make = MessageFactory(kind)
    first, second = Rotation.from_euler("xyz", [0.5, -1.0, 2.0]), Rotation.from_euler("xyz", [-0.3, 0.2, 1.0])
    transforms = [("/tf_static", 1.0, make.transform("link", "optical", first)),
                  ("/tf_static", 1.0, make.transform("link", "imu", second))]  # fmt: skip
    in_imu = (second.inv() * first).apply(-9.81 * DOWN)  # an accelerometer at rest measures the opposite
    sequence = write_bag(make, tmp_path, [*transforms, *measurements(make, in_imu, "imu")])
    gravity = sequence[0].gravity
    assert gravity is not None and float(gravity @ torch.from_numpy(DOWN)) > np.cos(np.radians(0.5))
    assert sequence[1].gravity is None


def test_accelerometer_in_the_frame_of_the_camera_needs_no_transforms(tmp_path: Path) -> None:
    make = MessageFactory("mcap")
    gravity = write_bag(make, tmp_path, measurements(make, -9.81 * DOWN))[0].gravity
    assert gravity is not None and float(gravity @ torch.from_numpy(DOWN)) > np.cos(np.radians(0.5))


@pytest.mark.parametrize(
    ("camera", "imu", "is_used"),
    [
        ("camera_color_optical_frame", "camera_imu_optical_frame", True),
        ("front_color_optical_frame", "rear_imu_optical_frame", False),
        ("camera_front_color_optical_frame", "camera_rear_imu_optical_frame", False),
        ("front/color_optical_frame", "rear/imu_optical_frame", False),
    ],
)
def test_only_optical_frames_of_one_camera_are_aligned(camera: str, imu: str, is_used: bool, tmp_path: Path) -> None:
    make = MessageFactory("mcap")
    gravity = write_bag(make, tmp_path, measurements(make, -9.81 * DOWN, imu), camera)[0].gravity
    assert (gravity is not None) == is_used


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_transform_without_a_valid_rotation_is_skipped(value: float, tmp_path: Path) -> None:
    make, tilt = MessageFactory("mcap"), Rotation.from_euler("x", 0.5)
    invalid, valid = (make.transform("optical", "imu", tilt) for _ in range(2))
    invalid.transforms[0].transform.rotation = make.store.types["geometry_msgs/msg/Quaternion"](*[value] * 4)
    transforms = [("/tf_static", 1.0, message) for message in (invalid, valid)]
    measured = measurements(make, tilt.inv().apply(-9.81 * DOWN), "imu")
    gravity = write_bag(make, tmp_path, [*transforms, *measured])[0].gravity
    assert gravity is not None and float(gravity @ torch.from_numpy(DOWN)) > np.cos(np.radians(0.5))


def test_accelerometer_of_the_same_camera_is_preferred(tmp_path: Path) -> None:
    """Both could be used: the names of the frames do not tell the cameras apart."""
    make = MessageFactory("mcap")
    others = measurements(make, 9.81 * DOWN, "camera_imu_optical_frame", "/another/imu")
    own = measurements(make, -9.81 * DOWN, "camera_imu_optical_frame", f"/{RGB.split('/')[1]}/imu")
    gravity = write_bag(make, tmp_path, [*others, *own], "camera_color_optical_frame")[0].gravity
    assert gravity is not None and float(gravity @ torch.from_numpy(DOWN)) > np.cos(np.radians(0.5))


def test_bag_without_accelerometer_has_no_gravity(tmp_path: Path) -> None:
    make = MessageFactory("mcap")
    assert write_bag(make, tmp_path, [])[0].gravity is None


@pytest.mark.parametrize(("camera", "imu"), [("", ""), ("optical", ""), ("", "imu")])
def test_frames_without_names_are_not_taken_as_the_same(
    camera: str, imu: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make = MessageFactory("mcap")
    with caplog.at_level(logging.WARNING):
        assert write_bag(make, tmp_path, measurements(make, -9.81 * DOWN, imu), camera)[0].gravity is None
    names = [name or "a frame without name" for name in (imu, camera)]
    assert f"the orientation of {names[0]} on /imu relative to {names[1]} is not in /tf_static" in caplog.text


@pytest.mark.parametrize(
    ("acceleration", "frame", "warning"),
    [
        (-DOWN, "optical", r"measures 1\.00 m/s\^2 .* instead of 9\.81; gravity is not used"),  # in units of g
        (-9.81 * DOWN, "imu", "the orientation of imu on /imu relative to optical is not in /tf_static"),
        (0 * DOWN, "optical", None),  # the topic of a gyroscope
    ],
)
def test_unusable_measurements_are_logged_and_not_used(
    acceleration: np.ndarray, frame: str, warning: str | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make = MessageFactory("mcap")
    messages = [("/imu", 15 + n / 100, make.imu(9.5 + n / 100, acceleration, frame)) for n in range(55)]
    with caplog.at_level(logging.WARNING):
        assert write_bag(make, tmp_path, messages)[0].gravity is None
    assert len(caplog.records) == (warning is not None)
    assert warning is None or re.search(warning, caplog.text)
