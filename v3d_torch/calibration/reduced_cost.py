"""Minimum cost of a bundle adjustment over poses and points, as a function of parameters of the camera."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.mapping.bundle_problem import BundleProblem, State


@torch.no_grad()
def differentiate_minimum_cost(problem: BundleProblem, state: State, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the minimum cost with respect to camera parameters, as sums over the observations of each pose.

    The second derivatives are twice the Schur complement of poses and points, which is the information on the
    parameters if poses and points are unknown (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000).

    Args:
        problem: Bundle adjustment of P poses, without batch dimensions.
        state: Poses and points, which need not be at the minimum.
        jacobian: Derivatives of the whitened residuals with respect to C parameters, float64, shape :math:`(C, 3, M)`.

    Returns:
        First derivatives, shape :math:`(P, C)`, and second derivatives, shape :math:`(P, C, C)`. Their sums over the
        poses are the derivatives of the minimum cost.
    """
    _, residuals = problem.residuals_at(state)
    remaining = problem.remaining(residuals, jacobian, len(state[1]))
    weighted = 2 * residuals.weights * remaining
    gradient = torch.einsum("cim,im->mc", weighted, residuals.whitened)
    hessian = torch.einsum("cim,dim->mcd", weighted, remaining)
    P, C = len(state[0]), len(jacobian)
    return (
        gradient.new_zeros(P, C).index_add_(0, problem.pose, gradient),
        hessian.new_zeros(P, C, C).index_add_(0, problem.pose, hessian),
    )
