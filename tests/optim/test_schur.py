"""Schur complement against the assembled normal equations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from v3d_torch.optim.schur import SCHUR_REGULARISATION, NormalEquations, solve_normal_equations, sum_columns


def equations(batch: tuple[int, ...], poses: int, points: int, observations: int) -> NormalEquations:
    """Random observations of points by free poses and by fixed ones."""
    generator = torch.Generator().manual_seed(0)
    pose = torch.randint(0, poses + 1, (*batch, observations), generator=generator)
    point = torch.randint(0, points, (*batch, observations), generator=generator)
    J = torch.randn(*batch, 9, 3, observations, generator=generator, dtype=torch.float64)
    g = torch.randn(*batch, 9, observations, generator=generator, dtype=torch.float64)
    blocks = (J[..., :, None, :, :] * J[..., None, :, :, :]).sum(dim=-2)
    U = sum_columns(blocks[..., :6, :6, :].flatten(-3, -2), pose, poses).unflatten(-2, (6, 6))
    V = sum_columns(blocks[..., 6:, 6:, :].flatten(-3, -2), point, points).unflatten(-2, (3, 3))
    gradients = sum_columns(g[..., :6, :], pose, poses), sum_columns(g[..., 6:, :], point, points)
    return NormalEquations(U, V, blocks[..., 6:, :6, :], *gradients, pose, point)


def solve_densely(system: NormalEquations, damping: float) -> Tensor:
    """Steps of poses, then of points, flattened."""
    F, P = system.U.shape[-1], system.V.shape[-1]
    H = torch.zeros(6 * F + 3 * P, 6 * F + 3 * P, dtype=torch.float64)
    for f in range(F):
        H[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] = system.U[..., f]
    for p in range(P):
        H[6 * F + 3 * p : 6 * F + 3 * p + 3, 6 * F + 3 * p : 6 * F + 3 * p + 3] = system.V[..., p]
    for m, (f, p) in enumerate(zip(system.pose.tolist(), system.point.tolist(), strict=True)):
        if f < F:
            rows, columns = slice(6 * F + 3 * p, 6 * F + 3 * p + 3), slice(6 * f, 6 * f + 6)
            H[rows, columns] += system.W[..., m]
            H[columns, rows] += system.W[..., m].T
    H.diagonal().mul_(1 + damping).add_(SCHUR_REGULARISATION)
    gradient = torch.cat([system.pose_gradient.T.flatten(), system.point_gradient.T.flatten()])
    return torch.linalg.solve(H, -gradient)


@pytest.mark.parametrize("poses", [0, 1, 3])
def test_solution_equals_the_dense_one(poses: int) -> None:
    system = equations((), poses, points=5, observations=40)
    xi, delta = solve_normal_equations(system, 1e-3)
    torch.testing.assert_close(torch.cat([xi.T.flatten(), delta.T.flatten()]), solve_densely(system, 1e-3))


def test_systems_of_a_batch_are_solved_as_alone() -> None:
    system = equations((2, 2), 3, 5, 40)
    damping = torch.tensor([[1e-3, 1e-2], [0.1, 10.0]], dtype=torch.float64)
    steps = solve_normal_equations(system, damping)
    for index in ((0, 0), (0, 1), (1, 0), (1, 1)):
        alone = solve_normal_equations(NormalEquations(*(column[index] for column in system)), float(damping[index]))
        for one, other in zip(alone, steps, strict=True):
            torch.testing.assert_close(one, other[index])
