"""Levenberg-Marquardt optimisation.

Pose refinement, bundle adjustment, dense alignment and the pose graph share this optimiser.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from v3d_torch.kernels.compiler import can_read, is_all_true

State = TypeVar("State")
System = TypeVar("System")

_INITIAL_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-5, 1e-9, 1e9
"""Initial, minimum and maximum damping, relative to the diagonal of the normal equations. The first step is nearly a
Gauss-Newton step."""

_DAMPING_FACTOR = 10
"""Factor by which the damping is reduced or increased after each step."""

DAMPING_SCHEDULE = (_INITIAL_DAMPING, _MIN_DAMPING, _MAX_DAMPING, float(_DAMPING_FACTOR))
"""The constants above, as arguments of kernels."""

REGULARISATION = 1e-9
"""Number added to the diagonal of normal equations, so that they have a solution without measurements, and for a pose
without edges; negligible compared with the information of a measurement."""

POSE_TOLERANCE = 1e-3
"""Relative change of the cost at convergence if one pose is estimated. Convergence is quadratic, so the next step would
change far less."""


@dataclass(frozen=True)
class OptimisationResult(Generic[State, System]):
    """Result of `levenberg_marquardt` for a batch of problems, of any shape.

    Attributes:
        state: States with the lowest costs.
        system: Result of ``linearise`` at ``state``.
        cost_before: Costs of the initial states, shape :math:`(...)`.
        cost_after: Costs of ``state``, shape :math:`(...)`.
        iterations: Number of steps tried for each problem, int64, shape :math:`(...)`.
        converged: Mask of the problems that converged, or were finished from the start, bool, shape :math:`(...)`.
    """

    state: State
    system: System
    cost_before: Tensor
    cost_after: Tensor
    iterations: Tensor
    converged: Tensor


def levenberg_marquardt(
    state: State,
    linearise: Callable[[State], tuple[Tensor, System]],
    step: Callable[[State, System, Tensor], State],
    iterations: int,
    tolerance: float = 1e-6,
    finished: Tensor | None = None,
) -> OptimisationResult[State, System]:
    """Minimise the costs of a batch of independent problems by damped Gauss-Newton steps.

    If a step lowers the cost, it is accepted and the damping is reduced; otherwise it is rejected and the damping is
    increased (Levenberg, 1944; Marquardt, 1963). Each problem of the batch has its own damping, and stays unchanged
    after it has converged.

    Args:
        state: Initial states: a tensor, or a tuple of tensors, whose first dimensions are those of the batch.
        linearise: Function from states to their costs, shape :math:`(...)`, and their normal equations in any form that
            ``step`` accepts, a tensor or a tuple of tensors.
        step: Function from states, their normal equations and the damping (relative to their diagonal), shape
            :math:`(...)`, to the next states.
        iterations: Maximum number of steps.
        tolerance: Relative change of the cost below which a problem has converged.
        finished: Mask of the problems whose states are returned unchanged, bool, shape :math:`(...)`; None for none.

    Returns:
        The states with the lowest costs, and statistics.
    """
    cost, system = linearise(state)
    cost_before, damping = cost, torch.full_like(cost, _INITIAL_DAMPING)
    converged = torch.zeros_like(cost, dtype=torch.bool) if finished is None else finished
    count = torch.zeros_like(cost, dtype=torch.int64)
    for _ in range(iterations):
        if is_all_true(converged):
            break
        candidate = step(state, system, damping)
        new_cost, new_system = linearise(candidate)
        is_lower = new_cost < cost
        # A small change of the cost after a heavily damped step does not indicate convergence.
        is_small = (damping < 1) & ((cost - new_cost).abs() <= tolerance * (cost + tolerance))
        accepted, count = is_lower & ~converged, count + ~converged
        state, system, cost = select(accepted, (candidate, new_system, new_cost), (state, system, cost))
        lower, higher = damping / _DAMPING_FACTOR, damping * _DAMPING_FACTOR
        damping = torch.where(is_lower, lower.clamp(min=_MIN_DAMPING), higher.clamp(max=_MAX_DAMPING))
        converged = converged | is_small
    return OptimisationResult(state, system, cost_before, cost, count, converged)


def select(mask: Tensor, new: Any, old: Any) -> Any:
    """Select the elements of a batch from two values of the same structure, as `torch.where` does for tensors.

    Args:
        mask: True for elements of ``new``, false for elements of ``old``, bool, shape :math:`(...)`.
        new: A tensor of shape :math:`(..., *)`, or a tuple of such tensors.
        old: A value of the same structure and shapes as ``new``.
    """
    if mask.ndim == 0 and can_read(mask):  # a single problem: nothing to copy
        return new if mask else old
    if isinstance(new, Tensor):
        return torch.where(mask.reshape(mask.shape + (1,) * (new.ndim - mask.ndim)), new, old)
    parts = [select(mask, a, b) for a, b in zip(new, old, strict=True)]
    return type(new)(*parts) if hasattr(new, "_fields") else tuple(parts)
