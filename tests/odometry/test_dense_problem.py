"""Least-squares problem of dense alignment: derivatives and information matrix."""

from __future__ import annotations

import scipy.stats
import torch
from helpers.rendered_planes import ALL_PIXELS, IDENTITY, LENS, WALL, A, Image, motion_error, render

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.odometry.dense_aligner import DenseAligner
from v3d_torch.odometry.dense_problem import AlignmentProblem
from v3d_torch.odometry.dense_view import Level


def finest_level(image: Image, camera: PinholeCamera = LENS) -> Level:
    aligner = DenseAligner(DenseOdometryConfig(halvings=(1,)), camera)
    return aligner.view(*image, ALL_PIXELS).levels[1]


def test_jacobian_equals_finite_differences() -> None:
    """Central differences with steps below a pixel."""
    level = finest_level(A)
    gain_and_bias = torch.tensor([1.0, 0.0], dtype=torch.float64)
    problem = AlignmentProblem(level, level, (IDENTITY, gain_and_bias), 0.003, DenseOdometryConfig())
    for axis in range(6):
        h = torch.zeros(6, dtype=torch.float64)
        h[axis] = 2e-3
        ahead, behind = (problem.residuals((se3_exp(sign * h), gain_and_bias)) for sign in (1, -1))
        for channel in range(2):
            valid = ahead.valid[channel] & behind.valid[channel]
            assert valid.sum() > 3000
            numeric = (ahead.values - behind.values)[channel, valid] / 4e-3
            jacobian = problem.reference.jacobian[channel, valid, axis]
            assert scipy.stats.pearsonr(jacobian, numeric)[0] > 0.99, (axis, channel)
            assert abs(float(jacobian @ numeric / (numeric @ numeric)) - 1) < 0.03, (axis, channel)


def test_gradient_of_the_cost_equals_finite_differences() -> None:
    """The gradient by motion, gain and bias."""
    level = finest_level(render(IDENTITY, planes=WALL))
    state = (se3_exp(torch.full((6,), 5e-4, dtype=torch.float64)), torch.tensor([1.02, -0.01], dtype=torch.float64))
    problem = AlignmentProblem(level, level, state, 0.003, DenseOdometryConfig())
    count = int(problem.residuals(state).valid.sum())
    _, (_, gradient) = problem.linearise(state)
    numeric = []
    for k in range(8):
        h = torch.zeros(8, dtype=torch.float64)
        h[k] = 2e-4
        costs = [problem.linearise((state[0] @ se3_exp(s * h[:6]), state[1] + s * h[6:]))[0] for s in (1, -1)]
        numeric.append((costs[0] - costs[1]) / 4e-4 * count / 2)
    expected = torch.tensor(numeric, dtype=torch.float64)
    assert torch.nn.functional.cosine_similarity(gradient, expected, dim=0) > 0.99
    torch.testing.assert_close(gradient, expected, rtol=0.1, atol=0.03 * float(expected.abs().max()))


def test_convention_information_is_of_the_left_perturbation() -> None:
    """With a motion that rolls the camera by 40 degrees, left and right perturbations differ clearly."""
    T_ba = se3_exp(torch.tensor([0.2, -0.1, 0.1, 0.0, 0.0, 0.7], dtype=torch.float64))
    a, b = A, render(T_ba)
    aligner = DenseAligner(DenseOdometryConfig(halvings=(2, 1)), LENS)
    views = aligner.view(*a, ALL_PIXELS), aligner.view(*b, ALL_PIXELS)
    alignment = aligner.align_views(*views, T_ba)
    assert alignment is not None
    assert motion_error(alignment, T_ba)[0] < 0.5
    state = alignment.T_ba, torch.tensor([1.0, 0.0], dtype=torch.float64)
    problem = AlignmentProblem(views[0].levels[1], views[1].levels[1], state, 0.003, DenseOdometryConfig())
    of_right = problem.information(problem.linearise(state)[1], problem.residuals(state).valid[0])
    ratios = []
    for xi in torch.eye(6, dtype=torch.float64):
        right = se3_log(invert(T_ba) @ se3_exp(1e-3 * xi) @ T_ba) / 1e-3  # exp(xi) T = T exp(right)
        ratios.append(float(xi @ alignment.information @ xi / (right @ of_right @ right)))
    assert max(ratios) < 1.1 * min(ratios)  # the noise scale is estimated at a slightly different state
