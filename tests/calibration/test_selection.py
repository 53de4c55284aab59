"""Which camera parameters are taken: those that a map tells, and that differ from the given ones."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from helpers.calibration_map import TRUE, make_map

from v3d_torch.calibration.problem import SelfCalibration
from v3d_torch.calibration.selection import (
    AGREES,
    NOT_DETERMINED,
    Estimate,
    ParameterSelection,
    covariance,
    decide,
    pixel_effect,
)
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.optim.jackknife import jackknife_covariance

KNOWN = replace(TRUE, readout=0.0)


def select(given: PinholeCamera, **settings: float) -> dict[str, Estimate]:
    """Estimates by name for a map that was built with a camera."""
    problem = SelfCalibration(make_map(given, KNOWN, **settings), given, Config())
    return {each.name: each for each in ParameterSelection(problem).estimates}


@pytest.mark.parametrize(
    ("value", "sigma", "blocks", "accepted", "reason"),
    [
        (5.0, 0.1, 10, True, ""),
        (5.0, 1.1, 10, False, NOT_DETERMINED),
        (5.0, math.inf, 3, False, NOT_DETERMINED),
        (math.nan, math.nan, 0, False, NOT_DETERMINED),
        (2.0, 1.0, 10, False, AGREES),
        (4.1, 1.0, 10, False, AGREES),  # the standard deviation is accurate to a quarter of itself
        (4.4, 1.0, 10, True, ""),
        (4.4, 1.0, 6, False, AGREES),  # less accurate
        (6.0, 1.0, 6, True, ""),
    ],
)
def test_estimate_is_accepted_if_it_is_accurate_and_differs(
    value: float, sigma: float, blocks: int, accepted: bool, reason: str
) -> None:
    estimate = decide("x", 0.0, value, sigma, blocks, tolerance=1.0)
    assert (estimate.accepted, estimate.reason) == (accepted, reason)


def test_nothing_is_taken_if_the_given_camera_is_right() -> None:
    estimates = select(KNOWN)
    assert not any(each.accepted for each in estimates.values())
    assert len(estimates) == 11  # focal lengths, centre, five coefficients, inverse-depth offset, readout


def test_only_the_group_that_is_wrong_is_accepted() -> None:
    estimates = select(replace(KNOWN, fx=1.08 * TRUE.fx, fy=1.08 * TRUE.fy))
    assert {name for name, each in estimates.items() if each.accepted} == {"fx", "fy"}
    for name in ("fx", "fy"):
        each = estimates[name]
        assert each.given == pytest.approx(1.08 * getattr(TRUE, name))
        assert abs(each.value - getattr(TRUE, name)) < 4 * each.sigma
    reasons = {each.reason for each in estimates.values() if not each.accepted}
    assert all(reason in {AGREES, NOT_DETERMINED} or reason.startswith("cannot be told apart") for reason in reasons)


@pytest.mark.parametrize(
    ("name", "difference", "accepted"), [("fx", 2.6, False), ("fx", 52.0, True), ("cx", 1.0, False), ("cx", 20.0, True)]
)
def test_difference_that_errors_of_the_camera_model_explain_is_not_accepted(
    name: str, difference: float, accepted: bool
) -> None:
    """With little noise. Focal lengths are accurate to 1.5 %, the centre to 0.5 % of the width."""
    other = name.replace("x", "y")
    given = replace(KNOWN, **{each: getattr(KNOWN, each) + difference for each in (name, other)})
    estimates = select(given, noise=0.02)
    for each in (estimates[name], estimates[other]):
        assert (each.accepted, each.reason) == ((True, "") if accepted else (False, AGREES))
        assert each.sigma >= (0.015 * each.value if name == "fx" else 0.005 * KNOWN.width)
        assert each.value == pytest.approx(getattr(TRUE, each.name), abs=0.5)


def test_intrinsics_of_a_camera_at_rest_are_not_accepted() -> None:
    estimates = select(replace(KNOWN, fx=1.08 * TRUE.fx, fy=1.08 * TRUE.fy), swing=torch.zeros(6).double())
    assert not any(each.accepted for each in estimates.values() if each.name in ("fx", "fy", "cx", "cy"))


def test_unknown_readout_has_no_given_value() -> None:
    estimate = select(TRUE)["readout"]
    assert estimate.given is None


def test_errors_that_last_longer_than_a_block_make_the_variance_larger() -> None:
    """Errors that change their sign only once: blocks of two keyframes take them as independent."""
    problem = SelfCalibration(make_map(KNOWN, KNOWN, keyframes=20, points=60), KNOWN, Config())
    _, at = problem.minimise(("fx",))
    drifting = at._replace(gradient=at.hessian[:, :, 0] * torch.linspace(-1, 1, len(at.hessian))[:, None].double())
    freedom = problem.residual_count / (problem.residual_count - problem.unknown_count)
    short = freedom * jackknife_covariance(drifting.gradient, drifting.hessian).covariance
    assert float(covariance(problem, drifting).covariance) > 1.2 * float(short)


def test_variance_is_at_least_that_of_independent_errors() -> None:
    """Nearly without gradients, all blocks agree, so that the variance of the jackknife is far too small."""
    problem = SelfCalibration(make_map(KNOWN, KNOWN, points=60), KNOWN, Config())
    _, at = problem.minimise(("fx", "cx"))
    agreeing = at._replace(gradient=torch.full_like(at.gradient, 1e-9))
    independent = torch.linalg.inv(at.hessian.sum(dim=0) / 2).diagonal()
    torch.testing.assert_close(covariance(problem, agreeing).covariance.diagonal(), independent)


def test_effect_of_a_shift_of_the_centre_is_the_shift() -> None:
    variances = torch.diag(torch.tensor([4.0, 9.0], dtype=torch.float64))
    assert pixel_effect(replace(TRUE, distortion=(0.0,) * 5), ("cx", "cy"), variances) == pytest.approx(math.sqrt(13))
