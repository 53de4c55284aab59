"""Levenberg-Marquardt with a robust kernel: what pose refinement, bundle adjustment and pose graph share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

State = TypeVar("State")
System = TypeVar("System")


def huber(squared: Tensor, limit: Tensor | float) -> tuple[Tensor, Tensor]:
    """Huber's kernel: quadratic below the limit, linear above.

    Args:
        squared: squared errors s, shape :math:`(M,)`.
        limit: square of the error at which the kernel turns linear.

    Returns:
        costs rho(s) and weights d rho / d s, both :math:`(M,)`.
    """
    weights = (limit / squared.clamp(min=1e-300)).sqrt().clamp(max=1.0)
    return squared * weights * (2 - weights), weights  # beyond the limit weights * weights * squared is the limit


def student_t(squared: Tensor, freedom: float) -> tuple[Tensor, Tensor]:
    """The t-distribution as a robust kernel: its long tails expect outliers (Kerl et al., ICRA 2013).

    Args:
        squared: squared errors s in sigmas, any shape.
        freedom: degrees of freedom.

    Returns:
        costs rho(s), twice the negative log-likelihood, and weights d rho / d s, both as ``squared``.
    """
    return (freedom + 1) * torch.log1p(squared / freedom), (freedom + 1) / (freedom + squared)


def student_t_scale(squared: Tensor, freedom: float) -> Tensor:
    """The sigma with which a t-distribution fits errors best, by fixed-point iteration (Kerl et al., ICRA 2013).

    Args:
        squared: squared errors, shape :math:`(M,)`, at least one.
        freedom: degrees of freedom.
    """
    variance = squared.mean()
    for _ in range(10):
        variance = (student_t(squared / variance.clamp(min=1e-12), freedom)[1] * squared).mean()
    return variance.sqrt()


@dataclass(frozen=True)
class Minimum(Generic[State, System]):
    """What `levenberg_marquardt` found.

    Attributes:
        state: at the least cost.
        system: what the steps from there are found by.
        cost_before: at the start.
        cost_after: at ``state``.
        iterations: steps tried.
        converged: whether it ended because the cost no longer changed.
    """

    state: State
    system: System
    cost_before: float
    cost_after: float
    iterations: int
    converged: bool


def levenberg_marquardt(
    state: State,
    linearise: Callable[[State], tuple[float, System]],
    step: Callable[[State, System, float], State],
    iterations: int,
    tolerance: float = 1e-6,
) -> Minimum[State, System]:
    """Damped Gauss-Newton: a step that lowers the cost is taken and the damping relaxed, else it is tightened.

    Args:
        state: where to start.
        linearise: state to its cost and normal equations, or what they are made of.
        step: state, what ``linearise`` gave and the damping (relative to the diagonal) to the next state.
        iterations: most steps tried.
        tolerance: relative change of the cost that ends the search.
    """
    cost, system = linearise(state)
    cost_before, damping, tried, converged = cost, 1e-5, 0, False
    while tried < iterations and not converged:
        candidate = step(state, system, damping)
        new_cost, new_system = linearise(candidate)
        tried += 1
        # A step damped to nothing changes nothing either: only one that was free to move tells of convergence.
        converged = damping < 1 and abs(cost - new_cost) <= tolerance * (cost + tolerance)
        if new_cost < cost:
            state, cost, system = candidate, new_cost, new_system
            damping = max(damping / 10, 1e-9)
        else:
            damping = min(damping * 10, 1e9)
    return Minimum(state, system, cost_before, cost, tried, converged)
