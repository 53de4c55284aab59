"""Levenberg-Marquardt and robust losses: convergence, derivatives, agreement with SciPy."""

from __future__ import annotations

import numpy as np
import scipy.stats
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.optim.levenberg_marquardt import levenberg_marquardt
from v3d_torch.optim.robust_losses import huber, student_t, student_t_scale


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


def rosenbrock(x: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Cost and normal equations of Rosenbrock's function, (..., 2)."""
    a, b = x.unbind(-1)
    o = torch.zeros_like(a)
    r = torch.stack([10 * (b - a * a), 1 - a], dim=-1)
    J = torch.stack([torch.stack([-20 * a, o + 10], dim=-1), torch.stack([o - 1, o], dim=-1)], dim=-2)
    return r.square().sum(dim=-1), (J.mT @ J, (J.mT @ r[..., None])[..., 0])


def damped_step(x: Tensor, system: tuple[Tensor, Tensor], damping: Tensor) -> Tensor:
    H, g = system
    return x - torch.linalg.solve(H + torch.diag_embed(damping[..., None] * H.diagonal(dim1=-2, dim2=-1)), g)


ROSENBROCK = rosenbrock, damped_step


def test_levenberg_marquardt_solves_rosenbrock() -> None:
    result = levenberg_marquardt(torch.tensor([-1.2, 1.0], dtype=torch.float64), *ROSENBROCK, iterations=50)
    torch.testing.assert_close(result.state, torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-6)
    assert result.converged
    assert result.iterations < 50
    assert result.cost_after < 1e-10 < result.cost_before


def test_problems_of_a_batch_are_solved_as_alone() -> None:
    """Each has its own damping and ends by itself; finished ones are not changed."""
    start = 2 * torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    finished = torch.tensor([False, False, True, False, False])
    result = levenberg_marquardt(start, *ROSENBROCK, iterations=50, finished=finished)
    assert len(result.iterations.unique()) > 2
    for k in range(5):
        if finished[k]:
            assert torch.equal(result.state[k], start[k]) and result.iterations[k] == 0
            continue
        alone = levenberg_marquardt(start[k], *ROSENBROCK, iterations=50)
        assert alone.iterations == result.iterations[k] and alone.converged == result.converged[k]
        torch.testing.assert_close(alone.state, result.state[k], rtol=1e-9, atol=1e-9)


def test_small_change_after_a_heavily_damped_step_is_not_convergence() -> None:
    """The first steps go uphill, so that the damping is far above 1 when the first step is accepted."""

    def parabola(x: Tensor) -> tuple[Tensor, Tensor]:
        return 1e6 + x.square(), x

    def step(x: Tensor, gradient: Tensor, damping: Tensor) -> Tensor:
        return torch.where(damping < 10, x + 1000, x - gradient / (1 + damping))

    result = levenberg_marquardt(torch.tensor(1.0, dtype=torch.float64), parabola, step, iterations=8)
    assert result.iterations == 8 and not result.converged


def test_student_t_scale_of_errors_that_are_all_zero_is_zero() -> None:
    assert student_t_scale(torch.zeros(5), 5.0) == 0
