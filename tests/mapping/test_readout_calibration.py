"""Calibration of the readout against the weighted mean and finite differences; its limits."""

from __future__ import annotations

from dataclasses import astuple

import pytest
import torch
from helpers.bundle_scenes import CAMERA, Scene
from helpers.rolling_camera import KINECT
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import MAX_READOUT
from v3d_torch.mapping.readout_calibration import combine_readouts, estimate_readout
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout


def combine(prior: Readout, slope: float, curvature: float) -> Readout:
    numbers = *astuple(prior), slope, curvature, abs(curvature)
    return Readout(*map(float, combine_readouts(*(torch.tensor(each, dtype=torch.float64) for each in numbers))))


@settings(max_examples=50)
@given(st.floats(0, 0.03), st.floats(0, 0.03), st.floats(1e3, 1e8), st.floats(1e3, 1e8))
def test_calibration_with_a_quadratic_cost_is_the_weighted_mean(a: float, b: float, prior: float, new: float) -> None:
    calibrated = combine(Readout(a, prior), slope=2 * new * (a - b), curvature=2 * new)
    assert calibrated.information == pytest.approx(0.85 * prior + 0.03 * new, rel=1e-12)
    assert calibrated.seconds == pytest.approx((0.85 * prior * a + 0.03 * new * b) / calibrated.information, abs=1e-9)


@pytest.mark.parametrize("curvature", [0.0, -1e6])
def test_calibration_ignores_a_cost_without_minimum(curvature: float) -> None:
    assert combine(KINECT, slope=5.0, curvature=curvature) == KINECT


def test_calibration_keeps_a_certain_readout() -> None:
    assert combine(GLOBAL_SHUTTER, slope=5.0, curvature=1e6) == GLOBAL_SHUTTER


def test_calibrated_readout_is_at_most_the_longest_accepted() -> None:
    calibrated = combine(Readout(0.01, 0.1), slope=-2e6 * 2.99, curvature=2e6)
    assert calibrated.seconds == pytest.approx(MAX_READOUT, abs=1e-6)


def test_derivatives_of_the_minimum_cost_equal_finite_differences() -> None:
    """Finite differences of the minimum cost for measurements that are shifted in both directions."""
    scene = Scene(poses=4, points=40, observers=3)
    uv_jacobian = 5.0 * torch.randn(len(scene.pose), 2, generator=torch.Generator().manual_seed(5)).double()
    optimum = scene.adjust(iterations=50, tolerance=1e-13)

    def cost(step: float) -> float:
        shifted = {"T_cw": optimum.T_cw, "points": optimum.points, "uv": scene.measured.uv + step * uv_jacobian}
        return float(scene.adjust(**shifted, iterations=50, tolerance=1e-13).cost_after)

    step = 1e-3
    less, same, more = cost(-step), cost(0.0), cost(step)
    slope, curvature = (more - less) / (2 * step), (more - 2 * same + less) / step**2
    expected = combine(Readout(0.02, 1e3), slope, curvature)
    state = 0.02, 1e3, uv_jacobian, optimum.T_cw, optimum.points
    seconds, information = estimate_readout(*state, **scene.observations)
    assert float(seconds) == pytest.approx(expected.seconds, abs=1e-6)
    assert float(information) == pytest.approx(expected.information, rel=0.05)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_change_that_a_pose_explains_keeps_the_estimate(noise: float) -> None:
    """A translation of one camera along its x axis moves its pixels and keeps all depths."""
    scene = Scene(poses=4, points=60, observers=3, noise=noise)
    optimum = scene.adjust(iterations=50, tolerance=1e-13)
    T = optimum.T_cw[scene.pose]
    z = (T[:, 2, :3] * optimum.points[scene.point]).sum(dim=1) + T[:, 2, 3]
    uv_jacobian = torch.stack([(scene.pose == 2) * CAMERA.fx / z, torch.zeros_like(z)], dim=1)
    state = uv_jacobian, optimum.T_cw, optimum.points
    seconds, information = estimate_readout(0.02, 1e4, *state, **scene.observations)
    assert (float(seconds), float(information)) == (0.02, 1e4)
    uv_jacobian[::2] = 0
    assert estimate_readout(0.02, 1e4, *state, **scene.observations)[1] > 1e4


@pytest.mark.parametrize("information", [-1.0, torch.nan, torch.tensor([1.0, -1.0])])
def test_information_that_is_negative_or_nan_is_rejected(information: float | torch.Tensor) -> None:
    scene = Scene(poses=4, points=40, observers=3)
    with pytest.raises(InputError, match=r"^information has a value that is negative or NaN; give inverse variances"):
        estimate_readout(0.02, information, torch.ones(120, 2), scene.T_cw, scene.points, **scene.observations)


@pytest.mark.parametrize("shape", [(1, 2), (2,), (40, 2), (120, 1)])
def test_readout_jacobian_of_another_shape_is_rejected(shape: tuple[int, ...]) -> None:
    """One row was used for all observations."""
    scene = Scene(poses=4, points=40, observers=3)
    assert len(scene.pose) == 120
    with pytest.raises(ShapeError):
        estimate_readout(0.02, 1e3, torch.ones(shape), scene.T_cw, scene.points, **scene.observations)
