"""Time compensation: depth delay first, then rolling shutter."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features, sample_depth
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.odometry.depth_delay import DepthDelayCompensation
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout, compensate_features
from v3d_torch.odometry.time_compensation import TimeCompensation

CAMERA = PinholeCamera(525.0, 520.0, 320.0, 240.0)
KINECT = Readout(0.026, 1e8)
VELOCITY = torch.tensor([0.5, -0.4, 0.6, 0.9, -1.1, 1.3], dtype=torch.float64)  # m/s and rad/s
DELAY = 0.02  # seconds

compensate = TimeCompensation(Config(), CAMERA)
compensate_depth_delay = DepthDelayCompensation(Config(), CAMERA)
compensate_rolling_shutter = partial(compensate_features, camera=CAMERA)


@pytest.fixture(scope="module")
def depth() -> Tensor:
    """Depth image of a slanted wall, metres, with a hole."""
    row, column = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    depth = (1 + 0.003 * column + 0.002 * row)[None]
    depth[:, 200:260, 300:380] = 0
    return depth


@pytest.fixture(scope="module")
def features(depth: Tensor) -> Features:
    """Features at random pixels, with the depth of the image there."""
    u, v = torch.rand(2, 300, generator=torch.Generator().manual_seed(5))
    pixel = torch.stack([20 + 600 * u, 20 + 440 * v], dim=1).round().to(torch.int64)
    z, octave = sample_depth(pixel, depth, max_depth=8.0), torch.zeros(300, dtype=torch.int64)
    return Features(pixel.double(), pixel, z, octave, torch.zeros(300, 32, dtype=torch.uint8))


def assert_equal(a: Features, b: Features) -> None:
    for name in ("uv", "pixel", "depth", "octave", "descriptors", "readout_jacobian"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_time_compensation_equals_rolling_shutter_after_depth_delay(features: Features, depth: Tensor) -> None:
    compensated = compensate(features, depth, DELAY, VELOCITY, KINECT)
    delayed = compensate_depth_delay(features, depth, VELOCITY, DELAY)
    assert_equal(compensated, compensate_rolling_shutter(delayed, VELOCITY, KINECT))
    assert not torch.equal(compensated.uv, features.uv) and not torch.equal(compensated.depth, features.depth)


def test_delay_of_the_camera_is_added_to_that_of_the_timestamps(features: Features, depth: Tensor) -> None:
    of_delayed_camera = TimeCompensation(Config(), replace(CAMERA, depth_delay=0.006))
    compensated = of_delayed_camera(features, depth, 0.014, VELOCITY, KINECT)
    expected = compensate(features, depth, 0.02, VELOCITY, KINECT)
    torch.testing.assert_close(compensated.depth, expected.depth)
    torch.testing.assert_close(compensated.uv, expected.uv)


def test_rolling_shutter_is_compensated_with_the_depth_of_the_colour_image(features: Features, depth: Tensor) -> None:
    compensated = compensate(features, depth, DELAY, VELOCITY, KINECT)
    with_delayed_depth = compensate_rolling_shutter(features, VELOCITY, KINECT)
    assert not torch.equal(compensated.uv, with_delayed_depth.uv)


def test_synchronous_depth_leaves_rolling_shutter_compensation_alone(features: Features, depth: Tensor) -> None:
    expected = compensate_rolling_shutter(features, VELOCITY, KINECT)
    assert_equal(compensate(features, depth, 0.0, VELOCITY, KINECT), expected)


def test_global_shutter_leaves_depth_delay_compensation_alone(features: Features, depth: Tensor) -> None:
    compensated = compensate(features, depth, DELAY, VELOCITY, GLOBAL_SHUTTER)
    expected = compensate_depth_delay(features, depth, VELOCITY, DELAY)
    assert torch.equal(compensated.uv, features.uv) and torch.equal(compensated.depth, expected.depth)


def test_features_of_a_camera_at_rest_are_unchanged(features: Features, depth: Tensor) -> None:
    at_rest = torch.zeros(6, dtype=torch.float64)
    compensated = compensate(features, depth, DELAY, at_rest, KINECT)
    assert torch.equal(compensated.uv, features.uv) and torch.equal(compensated.depth, features.depth)


def test_disabled_compensation_leaves_the_depth_unchanged(features: Features, depth: Tensor) -> None:
    disabled = TimeCompensation(Config.model_validate({"rolling_shutter": {"enabled": False}}), CAMERA)
    assert_equal(
        disabled(features, depth, DELAY, VELOCITY, KINECT), compensate_rolling_shutter(features, VELOCITY, KINECT)
    )


def test_second_compensation_replaces_the_first_also_beside_depth_edges(features: Features) -> None:
    depth = torch.full((1, CAMERA.height, CAMERA.width), 3.0)
    depth[:, :, 250:280], depth[:, 100:130, :] = 1.2, 0.0  # a pole before a wall, and a gap
    observed = replace(features, depth=sample_depth(features.pixel, depth, max_depth=8.0))
    once = compensate(observed, depth, DELAY, VELOCITY, KINECT)
    for first in (VELOCITY, -3 * VELOCITY):
        twice = compensate(compensate(observed, depth, DELAY, first, KINECT), depth, DELAY, VELOCITY, KINECT)
        torch.testing.assert_close(twice.depth, once.depth, rtol=0, atol=1e-12)
        torch.testing.assert_close(twice.uv, once.uv, rtol=0, atol=1e-9)
