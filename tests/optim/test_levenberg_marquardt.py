"""Levenberg-Marquardt and robust kernels: convergence, derivatives, agreement with SciPy."""

from __future__ import annotations

import numpy as np
import scipy.stats
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.optim.levenberg_marquardt import huber, levenberg_marquardt, student_t, student_t_scale


def test_huber_is_continuous_and_its_weight_is_the_derivative() -> None:
    squared = torch.linspace(0.01, 30, 500, dtype=torch.float64, requires_grad=True)
    costs, weights = huber(squared, 7.815)
    (derivative,) = torch.autograd.grad(costs.sum(), squared)
    torch.testing.assert_close(derivative, weights)
    beside, _ = huber(torch.tensor([7.815 - 1e-9, 7.815 + 1e-9], dtype=torch.float64), 7.815)
    assert abs(beside[1] - beside[0]) < 1e-8
    assert huber(torch.tensor([0.0, 100.0]), torch.inf)[0].tolist() == [0.0, 100.0]


@given(st.lists(st.floats(-20, 20), min_size=1, max_size=30), st.floats(2, 30))
def test_student_t_equals_the_likelihood_of_scipy(errors: list[float], degrees_of_freedom: float) -> None:
    residuals = torch.tensor(errors, dtype=torch.float64)
    squared = residuals.square().requires_grad_()
    costs, weights = student_t(squared, degrees_of_freedom)
    log_likelihood = scipy.stats.t.logpdf(residuals, degrees_of_freedom)
    expected = -2 * (log_likelihood - scipy.stats.t.logpdf(0, degrees_of_freedom))
    np.testing.assert_allclose(costs.detach().numpy(), expected, rtol=1e-9, atol=1e-9)
    (derivative,) = torch.autograd.grad(costs.sum(), squared)
    torch.testing.assert_close(derivative, weights.detach())


def test_student_t_scale_equals_the_fit_of_scipy() -> None:
    residuals = scipy.stats.t.rvs(5, scale=0.03, size=2000, random_state=1)
    residuals[:100] += 1.0  # outliers
    expected = scipy.stats.t.fit(residuals, fdf=5, floc=0)[2]
    scale = student_t_scale(torch.from_numpy(residuals).square(), 5.0)
    assert abs(float(scale) / expected - 1) < 0.02


def test_levenberg_marquardt_solves_rosenbrock() -> None:
    def linearise(x: Tensor) -> tuple[float, tuple[Tensor, Tensor]]:
        r = torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])
        J = torch.tensor([[-20 * float(x[0]), 10.0], [-1.0, 0.0]], dtype=torch.float64)
        return float(r @ r), (J.T @ J, J.T @ r)

    def step(x: Tensor, system: tuple[Tensor, Tensor], damping: float) -> Tensor:
        H, g = system
        return x - torch.linalg.solve(H + damping * H.diagonal().diag(), g)

    initial = torch.tensor([-1.2, 1.0], dtype=torch.float64)
    result = levenberg_marquardt(initial, linearise, step, iterations=50)
    torch.testing.assert_close(result.state, torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-6)
    assert result.converged
    assert result.iterations < 50
    assert result.cost_after < 1e-10 < result.cost_before
