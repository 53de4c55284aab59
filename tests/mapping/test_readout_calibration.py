"""Calibration of the readout against the weighted mean; its limits."""

from __future__ import annotations

import pytest
from helpers.rolling_camera import KINECT
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.geometry.camera import MAX_READOUT
from v3d_torch.mapping.readout_calibration import calibrate_readout
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout


@settings(deadline=None, max_examples=50)
@given(st.floats(0, 0.03), st.floats(0, 0.03), st.floats(1e3, 1e8), st.floats(1e3, 1e8))
def test_calibration_with_a_quadratic_cost_is_the_weighted_mean(a: float, b: float, prior: float, new: float) -> None:
    calibrated = calibrate_readout(Readout(a, prior), slope=2 * new * (a - b), curvature=2 * new)
    assert calibrated.information == pytest.approx(0.8 * prior + 0.1 * new, rel=1e-12)
    assert calibrated.seconds == pytest.approx((0.8 * prior * a + 0.1 * new * b) / calibrated.information, abs=1e-9)


@pytest.mark.parametrize("curvature", [0.0, -1e6])
def test_calibration_ignores_a_cost_without_minimum(curvature: float) -> None:
    assert calibrate_readout(KINECT, slope=5.0, curvature=curvature) == KINECT


def test_calibration_keeps_a_certain_readout() -> None:
    assert calibrate_readout(GLOBAL_SHUTTER, slope=5.0, curvature=1e6) == GLOBAL_SHUTTER


def test_calibrated_readout_is_at_most_the_longest_accepted() -> None:
    calibrated = calibrate_readout(Readout(0.01, 1.0), slope=-2e6 * 2.99, curvature=2e6)
    assert calibrated.seconds == pytest.approx(MAX_READOUT, abs=1e-6)
