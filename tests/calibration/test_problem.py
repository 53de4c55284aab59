"""Bundle adjustment with free camera parameters: derivatives, true values, uncertainty."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.calibration_map import PIXEL_SIGMA, TRUE, make_map
from torch import Tensor

from v3d_torch.calibration.parameters import DERIVATIVE_STEPS, LIMITS, get_values, groups_of, with_values
from v3d_torch.calibration.problem import SelfCalibration
from v3d_torch.calibration.selection import covariance
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera

ALL = tuple(name for group in groups_of(TRUE) for name in group.parameters)
INTRINSICS = ("fx", "fy", "cx", "cy")


def make_problem(given: PinholeCamera, **settings: float) -> SelfCalibration:
    return SelfCalibration(make_map(given, **settings), given, Config())


def distort(values: Tensor, xy: Tensor) -> Tensor:
    """Recorded pixels by the formula of the Brown-Conrady model, differentiable in all parameters."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    x, y = xy.unbind(dim=1)
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    v = fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
    return torch.stack([u, v], dim=1)


def test_jacobian_of_pixels_is_that_of_the_recorded_image_seen_from_the_undistorted_one() -> None:
    """A change of a parameter moves a projected point in the recorded image as the formula says, to first order."""
    problem = make_problem(TRUE, noise=0.0)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = problem.given_values(names)
    jacobian = problem.jacobian(names, values, problem.T_cw, problem.points)
    T = problem.T_cw[problem.observations.pose]
    points = (T[:, :3, :3] @ problem.points[problem.observations.point, :, None])[..., 0] + T[:, :3, 3]
    xy = points[:, :2] / points[:, 2:]
    expected = torch.autograd.functional.jacobian(lambda v: distort(v, xy), values)  # (M, 2, C)
    by_xy = torch.autograd.functional.jacobian(lambda p: distort(values, p).sum(dim=0), xy).permute(1, 0, 2)
    to_undistorted = torch.diag(values[:2]) @ torch.linalg.inv(by_xy)
    scale = torch.linalg.det(to_undistorted).sqrt() * problem.observations.measured.pixel_sigma
    expected = (to_undistorted @ expected) / scale[:, None, None]
    torch.testing.assert_close(
        jacobian[:, :2].permute(2, 1, 0), expected, rtol=1e-3, atol=2e-3 * float(expected.abs().max())
    )


def test_jacobian_of_depth_and_readout() -> None:
    problem = make_problem(TRUE)
    names = ("inverse_depth_offset", "readout")
    jacobian = problem.jacobian(names, problem.given_values(names), problem.T_cw, problem.points)
    assert torch.allclose(jacobian[0, 2], -1 / problem.observations.measured.inverse_depth_sigma)
    assert jacobian[0, :2].abs().max() < 1e-9 > jacobian[1, 2].abs().max()


@pytest.mark.parametrize(
    "given",
    [
        replace(TRUE, fx=1.1 * TRUE.fx, fy=0.9 * TRUE.fy),
        replace(TRUE, cx=TRUE.cx + 10, cy=TRUE.cy - 10, inverse_depth_offset=0.01),
        replace(TRUE, distortion=(0.0,) * 5),
    ],
)
def test_true_values_are_found_from_wrong_ones(given: PinholeCamera) -> None:
    problem = make_problem(given, noise=0.0)
    values, _ = problem.minimise(ALL)
    expected = torch.tensor(get_values(TRUE, 0.0, ALL))
    tolerance = torch.tensor([0.05 if name in INTRINSICS else 2e-3 for name in ALL])
    assert bool(((values - expected).abs() < tolerance).all()), values - expected


def test_true_readout_is_found() -> None:
    pinhole = replace(TRUE, distortion=(0.0,) * 5)
    tables = make_map(pinhole, pinhole, noise=0.0, readout=0.02)
    values, _ = SelfCalibration(tables, pinhole, Config()).minimise(("readout",))
    assert float(values[0]) == pytest.approx(0.02, abs=1e-4)


def test_noise_is_estimated_from_the_residuals() -> None:
    problem = make_problem(TRUE)
    assert float(problem.observations.measured.pixel_sigma[0]) == pytest.approx(PIXEL_SIGMA, rel=0.1)
    assert problem.observations.measured.inverse_depth_sigma == pytest.approx(0.003, rel=0.25)


def test_uncertainty_agrees_with_the_errors_over_many_maps() -> None:
    """Mean squared errors in standard deviations (NEES). The jackknife of few blocks overestimates the covariance."""
    names, squared = ("fx", "cx", "k1"), []
    expected = torch.tensor(get_values(TRUE, 0.0, names))
    for seed in range(12):
        problem = make_problem(TRUE, seed=seed, points=80)
        values, at = problem.minimise(names)
        error = values - expected
        squared.append(float(error @ torch.linalg.solve(covariance(problem, at).covariance, error)) / len(names))
    assert 0.3 < sum(squared) / len(squared) < 1.5


def test_given_values_hold_for_parameters_that_are_not_free() -> None:
    """A map that was built with a better camera is calibrated relative to the given one."""
    given = replace(TRUE, cx=TRUE.cx + 4)
    tables = make_map(TRUE, noise=0.0)
    problem = SelfCalibration(tables, TRUE, Config(), given)
    assert float(problem.minimise(("cx",))[0][0]) == pytest.approx(TRUE.cx, abs=0.05)
    free = problem.minimise(("fx",))[0]
    assert abs(float(free[0]) - TRUE.fx) > 0.1  # biased by the wrong principal point


def test_differences_at_the_limits_are_those_of_accepted_cameras() -> None:
    for value in LIMITS["inverse_depth_offset"]:
        for sign in (1, -1):
            with_values(TRUE, {"inverse_depth_offset": value + sign * DERIVATIVE_STEPS["inverse_depth_offset"]})
