"""Kernels of bundle adjustment equal their torch twins on random and degenerate problems."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers.random_numbers import RandomNumbers
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.mapping import readout_calibration  # noqa: F401 - registers a kernel
from v3d_torch.mapping.bundle_problem import BundleProblem, prepare_bundle

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

BUNDLE_ADJUST = TWINS["v3d_torch.mapping.bundle_adjustment._minimise"]
DERIVATIVES = TWINS["v3d_torch.mapping.readout_calibration.reduced_cost_derivatives"]
CAMERA = PinholeCamera(fx=500.0, fy=510.0, cx=320.0, cy=240.0)

Problem = tuple[Tensor, Tensor, BundleProblem]
"""Poses, points, and observations."""


def make_problem(poses: int, points: int, observations: int, fixed: list[int], seed: int = 0) -> Problem:
    """Observations of random points by random poses near the origin, with noise and outliers, in random order."""
    random = RandomNumbers(seed)
    T_cw = se3_exp(0.1 * random.normal(poses, 6))
    positions = 0.5 * random.normal(points, 3) + torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    # Some pairs of a pose and a point occur twice.
    pose = torch.randint(0, max(poses, 1), (observations,), generator=random.generator)
    point = torch.randint(0, max(points, 1), (observations,), generator=random.generator)
    in_camera = (T_cw[pose, :3, :3] @ positions[point, :, None])[..., 0] + T_cw[pose, :3, 3]
    uv = CAMERA.project(in_camera) + random.normal(observations, 2)
    uv[::17] += 50.0
    inverse_depth = 1 / in_camera[:, 2] + 0.003 * random.normal(observations)
    inverse_depth[::3] = 0.0
    sigma = 1.2 ** (torch.arange(observations) % 5).double()
    weights = random.uniform(observations)
    weights[::5] = 0.0
    is_fixed = torch.isin(torch.arange(poses), torch.tensor(fixed, dtype=torch.int64))
    start = se3_exp(0.01 * random.normal(poses, 6)) @ T_cw, positions + 0.02 * random.normal(points, 3)
    measured = uv, pose, point, CAMERA.K, inverse_depth, sigma, 0.003
    problem, state, _ = prepare_bundle(*start, *measured, is_fixed, weights, None)
    return *state, problem


PROBLEMS = {
    "usual": make_problem(6, 60, 300, [0]),
    "many poses": make_problem(20, 200, 3000, [0, 5, 6]),
    "free gauge": make_problem(4, 40, 160, []),
    "all poses fixed": make_problem(4, 40, 160, [0, 1, 2, 3]),
    "one observation": make_problem(2, 1, 1, [0]),
    "unobserved points": make_problem(3, 100, 40, [0]),
    "unobserved poses": make_problem(30, 40, 20, [0]),
    "no observations": make_problem(3, 5, 0, [0]),
    "no points": make_problem(3, 0, 0, [0]),
    "no poses": make_problem(0, 0, 0, []),
}


def adjust(T_cw: Tensor, points: Tensor, problem: BundleProblem, *, compiled: bool, iterations: int = 5) -> Any:
    return BUNDLE_ADJUST[compiled](T_cw, points, *problem, iterations=iterations, tolerance=1e-8)


@pytest.mark.parametrize("name", PROBLEMS)
def test_kernel_of_bundle_adjustment_equals_its_twin(name: str) -> None:
    expected, found = (adjust(*PROBLEMS[name], compiled=compiled) for compiled in (False, True))
    assert found.iterations == expected.iterations
    assert math.isclose(found.cost_before, expected.cost_before, rel_tol=1e-12)
    assert math.isclose(found.cost_after, expected.cost_after, rel_tol=1e-9, abs_tol=1e-12)
    for field in ("T_cw", "points", "chi2"):
        torch.testing.assert_close(getattr(found, field), getattr(expected, field), rtol=1e-6, atol=1e-8)


def test_points_behind_the_camera_have_infinite_error_in_both() -> None:
    T_cw, points, problem = PROBLEMS["usual"]
    points = points.clone()
    points[:5, 2] = -3.0
    expected, found = (adjust(T_cw, points, problem, compiled=each, iterations=0) for each in (False, True))
    assert found.chi2.isinf().any()
    torch.testing.assert_close(found.chi2, expected.chi2, rtol=1e-10, atol=1e-10)
    assert torch.equal(found.T_cw, expected.T_cw)


def test_kernel_leaves_its_arguments_and_fixed_poses_unchanged() -> None:
    T_cw, points, problem = PROBLEMS["many poses"]
    before = T_cw.clone(), points.clone()
    found = adjust(T_cw, points, problem, compiled=True)
    assert torch.equal(T_cw, before[0]) and torch.equal(points, before[1])
    assert torch.equal(found.T_cw[[0, 5, 6]], T_cw[[0, 5, 6]])


@pytest.mark.parametrize("name", PROBLEMS)
def test_kernel_of_the_derivatives_equals_its_twin(name: str) -> None:
    problem = PROBLEMS[name][2]
    derivative = torch.randn(problem.scale.shape, generator=torch.Generator().manual_seed(1)).double()
    at_minimum = adjust(*PROBLEMS[name], compiled=False, iterations=20)
    arguments = at_minimum.T_cw, at_minimum.points, derivative, *problem
    expected, found = (torch.stack(DERIVATIVES[compiled](*arguments)) for compiled in (False, True))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6 * max(1.0, abs(float(expected[1]))))


@pytest.mark.parametrize("compiled", [False, True])
def test_problems_of_a_batch_are_solved_as_alone(compiled: bool) -> None:
    """Padded to the same sizes; both implementations treat each problem of a batch as if it were alone."""
    problems = [make_problem(6, 60, 300, [0], seed=seed) for seed in range(3)]
    batch = [torch.stack(columns) for columns in zip(*((T, X, *rest) for T, X, rest in problems), strict=True)]
    together = BUNDLE_ADJUST[compiled](*batch, iterations=5, tolerance=1e-8)
    for k, problem in enumerate(problems):
        alone = adjust(*problem, compiled=compiled)
        for name, one, other in zip(alone._fields, alone, together, strict=True):
            # On some processors torch rounds products of a batch differently, which squared errors amplify most.
            rtol = 1e-7 if name == "chi2" and not compiled else 1e-8
            torch.testing.assert_close(one, other[k], rtol=rtol, atol=1e-9)
