"""Levenberg-Marquardt optimisation and robust kernels.

Pose refinement, bundle adjustment, dense alignment and the pose graph share this optimiser.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

State = TypeVar("State")
System = TypeVar("System")

_INITIAL_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-5, 1e-9, 1e9
"""Damping relative to the diagonal of the normal equations. The first step is nearly a Gauss-Newton step."""

_DAMPING_FACTOR = 10
"""Change of the damping after each step."""

DAMPING_SCHEDULE = (_INITIAL_DAMPING, _MIN_DAMPING, _MAX_DAMPING, float(_DAMPING_FACTOR))
"""The values above, for kernels."""

_SCALE_ITERATIONS = 10
"""Fixed-point iterations for the scale of a t-distribution; each one reduces the error by a constant factor."""


def huber(squared: Tensor, threshold: Tensor | float) -> tuple[Tensor, Tensor]:
    r"""Huber's kernel on squared errors: quadratic up to the threshold, linear beyond.

    .. math::
        \rho(s) = s \;\text{if}\; s \le k^2, \; 2 k \sqrt{s} - k^2 \;\text{otherwise}

    Huber, Robust estimation of a location parameter, Annals of Mathematical Statistics, 1964.

    Args:
        squared: Squared errors :math:`s`, shape :math:`(M,)`.
        threshold: Squared error :math:`k^2` at which the kernel turns linear, a number or shape :math:`(M,)`.

    Returns:
        Costs :math:`\rho(s)` and weights :math:`d\rho / ds`, both of shape :math:`(M,)`.
    """
    weights = (threshold / squared.clamp(min=1e-300)).sqrt().clamp(max=1.0)
    return squared * weights * (2 - weights), weights  # beyond the threshold, squared * weights^2 equals the threshold


def student_t(squared: Tensor, degrees_of_freedom: float) -> tuple[Tensor, Tensor]:
    r"""Robust kernel of the t-distribution, whose heavy tails model outliers (Kerl et al., ICRA 2013).

    .. math::
        \rho(s) = (\nu + 1) \log(1 + s / \nu), \qquad \rho'(s) = \frac{\nu + 1}{\nu + s}

    Args:
        squared: Squared errors :math:`s` in units of the scale :math:`\sigma^2`, any shape.
        degrees_of_freedom: Degrees of freedom :math:`\nu`.

    Returns:
        Costs :math:`\rho(s)`, twice the negative log-likelihood up to a constant, and weights :math:`d\rho / ds`, both
        of the shape of ``squared``.
    """
    costs = (degrees_of_freedom + 1) * torch.log1p(squared / degrees_of_freedom)
    return costs, (degrees_of_freedom + 1) / (degrees_of_freedom + squared)


def student_t_scale(squared: Tensor, degrees_of_freedom: float) -> Tensor:
    r"""Maximum-likelihood scale of a t-distribution, by fixed-point iteration (Kerl et al., ICRA 2013).

    .. math::
        \sigma^2 \leftarrow \frac{1}{M} \sum_i r_i^2\, \frac{\nu + 1}{\nu + r_i^2 / \sigma^2}

    Args:
        squared: Squared errors :math:`r_i^2`, shape :math:`(M,)`, at least one.
        degrees_of_freedom: Degrees of freedom :math:`\nu`.

    Returns:
        Scale :math:`\sigma`, in the unit of the errors, shape :math:`()`.
    """
    variance = squared.mean()
    for _ in range(_SCALE_ITERATIONS):
        weights = student_t(squared / variance.clamp(min=1e-12), degrees_of_freedom)[1]
        variance = (weights * squared).mean()
    return variance.sqrt()


@dataclass(frozen=True)
class OptimisationResult(Generic[State, System]):
    """Result of `levenberg_marquardt`.

    Attributes:
        state: State with the lowest cost.
        system: Result of ``linearise`` at ``state``.
        cost_before: Cost of the initial state.
        cost_after: Cost of ``state``.
        iterations: Number of steps tried.
        converged: True if the optimisation ended because the cost no longer changed.
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
) -> OptimisationResult[State, System]:
    """Minimise a cost by damped Gauss-Newton steps.

    A step that lowers the cost is accepted and the damping reduced; otherwise the step is rejected and the damping
    increased (Levenberg, 1944; Marquardt, 1963).

    Args:
        state: Initial state.
        linearise: Function from a state to its cost and its normal equations, in any form that ``step`` accepts.
        step: Function from a state, its normal equations and the damping (relative to their diagonal) to the next
            state.
        iterations: Maximum number of steps.
        tolerance: Relative change of the cost below which the optimisation has converged.

    Returns:
        The state with the lowest cost, and statistics.
    """
    cost, system = linearise(state)
    cost_before, damping, iteration, converged = cost, _INITIAL_DAMPING, 0, False
    while iteration < iterations and not converged:
        candidate = step(state, system, damping)
        new_cost, new_system = linearise(candidate)
        iteration += 1
        # A heavily damped step changes the cost little anyway and does not indicate convergence.
        converged = damping < 1 and abs(cost - new_cost) <= tolerance * (cost + tolerance)
        if new_cost < cost:
            state, cost, system = candidate, new_cost, new_system
            damping = max(damping / _DAMPING_FACTOR, _MIN_DAMPING)
        else:
            damping = min(damping * _DAMPING_FACTOR, _MAX_DAMPING)
    return OptimisationResult(state, system, cost_before, cost, iteration, converged)
