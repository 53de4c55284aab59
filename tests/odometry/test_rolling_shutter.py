"""Rolling-shutter compensation, and the readout of a camera."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import camera_inputs
from helpers.rolling_camera import AT_REST, CAMERA, KINECT, VELOCITY, features_of, observe_rolling, points_in_view
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.errors import ConfigError
from v3d_torch.odometry.rolling_shutter import (
    GLOBAL_SHUTTER,
    Readout,
    compensate_features,
    compensate_rolling_shutter,
)


def max_error(velocity: Tensor, readout: Readout) -> float:
    """Largest distance of compensated features to the projections at the time of the middle row, pixels."""
    observed = observe_rolling(points_in_view(), velocity, KINECT.seconds)
    compensated = compensate_features(observed, velocity, readout, CAMERA)
    return float((compensated.uv - CAMERA.project(points_in_view())).norm(dim=1).max())


def test_compensation_moves_features_to_the_time_of_the_middle_row() -> None:
    assert max_error(VELOCITY, Readout(0.0, 1.0)) > 10
    assert max_error(VELOCITY, KINECT) < 0.1


def test_readout_jacobian_is_the_derivative_by_the_readout() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    shorter, longer = (
        compensate_features(observed, VELOCITY, Readout(seconds, 1.0), CAMERA) for seconds in (0.010, 0.020)
    )
    torch.testing.assert_close((longer.uv - shorter.uv) / 0.010, shorter.readout_jacobian, rtol=1e-9, atol=1e-6)


def test_features_without_depth_are_compensated_as_infinitely_far() -> None:
    uv = CAMERA.project(points_in_view())
    far = features_of(uv, torch.full((len(uv),), 1e9).double())
    without_depth = features_of(uv, torch.zeros(len(uv)).double())
    compensate = partial(compensate_features, camera=CAMERA)
    torch.testing.assert_close(
        compensate(without_depth, VELOCITY, KINECT).uv, compensate(far, VELOCITY, KINECT).uv, rtol=0, atol=1e-6
    )


def test_compensation_with_another_velocity_replaces_the_first() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    compensate = partial(compensate_features, camera=CAMERA)
    twice = compensate(compensate(observed, -2 * VELOCITY, KINECT), VELOCITY, KINECT)
    torch.testing.assert_close(twice.uv, compensate(observed, VELOCITY, KINECT).uv, rtol=0, atol=1e-9)
    torch.testing.assert_close(compensate(twice, AT_REST, KINECT).uv, observed.uv, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("velocity", "readout"), [(AT_REST, KINECT), (VELOCITY, GLOBAL_SHUTTER)])
def test_features_are_unchanged_at_rest_or_with_a_global_shutter(velocity: Tensor, readout: Readout) -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    assert torch.equal(compensate_features(observed, velocity, readout, CAMERA).uv, observed.uv)


def test_only_the_readout_can_have_batch_dimensions() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    given = observed.uv, observed.pixel[:, 1], observed.inverse_depth, VELOCITY
    readouts = torch.tensor([KINECT.seconds, 0.0], dtype=torch.float64)
    found = compensate_rolling_shutter(*given, readouts, CAMERA.K, CAMERA.height)
    alone = [compensate_rolling_shutter(*given, each, CAMERA.K, CAMERA.height) for each in readouts]
    for one, other in zip(found, zip(*alone, strict=True), strict=True):
        torch.testing.assert_close(one, torch.stack(other))


def test_compensation_of_no_features_is_empty() -> None:
    observed = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)[torch.zeros(0, dtype=torch.int64)]
    assert len(compensate_features(observed, VELOCITY, KINECT, CAMERA)) == 0


@pytest.mark.parametrize("height", [1, 0, -480])
def test_image_with_less_than_two_rows_is_rejected(height: int) -> None:
    uv, each = torch.zeros(3, 2, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    with pytest.raises(ConfigError, match=f"^height is {height}; give at least 2 rows$"):
        compensate_rolling_shutter(uv, each, each, VELOCITY, 0.02, CAMERA.K, height, uv)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("uv", (4, 3)),
        ("row", (3,)),
        ("inverse_depth", (3,)),
        ("inverse_depth", ()),
        ("velocity", (3,)),
        ("velocity", (7,)),
        ("K", (2, 2)),
        ("K", (3, 4)),
        ("readout_jacobian", (3, 2)),
        ("readout_jacobian", (4, 1)),
        ("readout_jacobian", (4,)),
        ("valid", (3,)),
    ],
)
def test_arguments_of_another_shape_are_rejected(name: str, shape: tuple[int, ...]) -> None:
    """The compiled function read memory behind a velocity of three numbers, and behind too few derivatives."""
    dtype = torch.bool if name == "valid" else torch.float64
    given = {key: each[0] for key, each in camera_inputs.rolling(1, 4, torch.float64).items() if key != "valid"}
    with pytest.raises(ShapeError):
        compensate_rolling_shutter(**given | {name: torch.ones(shape, dtype=dtype)}, readout=0.02, height=480)


def test_readout_jacobian_can_have_another_dtype_or_more_dimensions() -> None:
    given = {key: each[0] for key, each in camera_inputs.rolling(1, 4, torch.float64).items() if key != "valid"}
    expected = compensate_rolling_shutter(**given, readout=0.02, height=480)
    jacobian = given.pop("readout_jacobian")
    single = compensate_rolling_shutter(**given, readout_jacobian=jacobian.float(), readout=0.02, height=480)
    several = compensate_rolling_shutter(**given, readout_jacobian=jacobian.expand(3, 4, 2), readout=0.02, height=480)
    for k in range(2):
        torch.testing.assert_close(single[k], expected[k], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(several[k], expected[k].expand(3, 4, 2))


def test_readout_of_a_camera_is_certain_if_given_else_the_prior() -> None:
    prior = Config().rolling_shutter
    assert Readout.from_camera(CAMERA, prior) == Readout(prior.readout, prior.readout_sigma**-2)
    assert Readout.from_camera(replace(CAMERA, readout=0.0), prior) == GLOBAL_SHUTTER
    assert Readout.from_camera(replace(CAMERA, readout=0.025), prior) == Readout(0.025, math.inf)


def test_standard_deviation_of_a_readout() -> None:
    assert Readout(0.02, 1e4).sigma == pytest.approx(0.01) and GLOBAL_SHUTTER.sigma == 0


@pytest.mark.parametrize(
    "attributes", [{"seconds": 0.1, "information": 1.0}, {"seconds": math.nan, "information": 1.0}]
)
def test_readout_out_of_range_is_rejected(attributes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"readout .*(0\.1|nan)"):
        Readout.from_dict(attributes)
