r"""Refinement of essential matrices: least squares of Sampson distances over two rotations U and V.

.. math::
    E = \frac{1}{\sqrt 2}\, U \,\mathrm{diag}(1, 1, 0)\, V^\top

has five degrees of freedom: the rotation of U, and that of V about its first two columns. Hartley and Zisserman,
Multiple View Geometry, 2004, Sec. 9.6 and 11.4.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from v3d_torch.geometry.gradients import without_second_derivatives, zero_with_gradient
from v3d_torch.geometry.se3 import hat, se3_exp
from v3d_torch.kernels import sampson as kernels
from v3d_torch.kernels.compiler import compiled_by, is_all_true
from v3d_torch.optim.implicit import jacobian
from v3d_torch.optim.levenberg_marquardt import DAMPING_SCHEDULE, REGULARISATION, levenberg_marquardt, select
from v3d_torch.runtime.batches import to_rows

_ROUNDS = 3
"""Number of rounds of refinement on the inliers; all pairs are classified again after each round."""

_ITERATIONS, _TOLERANCE = 10, 1e-6
"""Maximum number of steps in a round, and relative change of the cost that ends the round."""


State = tuple[Tensor, Tensor]
"""Rotations U and V, shape :math:`(..., 3, 3)` each, of an essential matrix."""


def compose(U: Tensor, V: Tensor) -> Tensor:
    """Essential matrices U diag(1, 1, 0) V^T, of unit norm."""
    return 0.5**0.5 * (U[..., :2] @ V[..., :2].mT)


def decompose(E: Tensor) -> State:
    """Rotations U and V of the essential matrices nearest to E; the third columns do not matter."""
    U, _, Vh = torch.linalg.svd(E)
    u, v = U[..., :2], Vh.mT[..., :2]
    U, V = (torch.cat([Q, torch.linalg.cross(Q[..., 0], Q[..., 1])[..., None]], dim=-1) for Q in (u, v))
    return U, V


def _move(state: State, x: Tensor) -> State:
    """State after an update (..., 5): rotation of U about three axes, and of V about its first two columns.

    Rotating both about their third columns does not change E.
    """
    U, V = state
    turns = x[..., :3], (V[..., :2] @ x[..., 3:, None])[..., 0]
    R_u, R_v = (se3_exp(torch.cat([torch.zeros_like(turn), turn], dim=-1))[..., :3, :3] for turn in turns)
    return R_u @ U, R_v @ V


class EpipolarProblem(NamedTuple):
    """Pairs of pixels in two images.

    Attributes:
        a: Homogeneous pixels in image a, shape :math:`(..., N, 3)`.
        b: Homogeneous pixels in image b, shape :math:`(..., N, 3)`.
        K_inverse: Inverse camera matrix, shape :math:`(..., 3, 3)`.
        weights: Weight of each pair, shape :math:`(..., N)`.
    """

    a: Tensor
    b: Tensor
    K_inverse: Tensor
    weights: Tensor

    def sampson(self, E: Tensor) -> Tensor:
        """Sampson distances, signed, pixels: (..., 3, 3) to (..., N)."""
        F = self.K_inverse.mT @ E @ self.K_inverse
        line_b, line_a = self.a @ F.mT, self.b @ F
        return (line_b * self.b).sum(dim=-1) / _length(line_a, line_b)

    def jacobian(self, state: State) -> Tensor:
        """Derivatives of the Sampson distances with respect to the update of `_move`, (..., 5, N)."""
        (U, V), E = state, compose(*state)
        axes = torch.cat([torch.eye(3, dtype=U.dtype, device=U.device).expand_as(U), V[..., :2].mT], dim=-2)
        turns = hat(torch.cat([torch.zeros_like(axes), axes], dim=-1))[..., :3, :3]  # 5 x 3 x 3
        E, K_inverse = E[..., None, :, :], self.K_inverse[..., None, :, :]
        tangents = torch.cat([turns[..., :3, :, :] @ E, E @ turns[..., 3:, :, :].mT], dim=-3)
        F, G = (K_inverse.mT @ M @ K_inverse for M in (E, tangents))
        a, b = self.a.mT[..., None, :, :], self.b.mT[..., None, :, :]
        line_b, line_a, change_b, change_a = F @ a, F.mT @ b, G @ a, G.mT @ b  # 3 x N
        length = _length(line_a.mT, line_b.mT)
        distance = (line_b * b).sum(dim=-2) / length
        stretch = (line_a * change_a)[..., :2, :].sum(dim=-2) + (line_b * change_b)[..., :2, :].sum(dim=-2)
        return (change_b * b).sum(dim=-2) / length - distance * stretch / length.square()

    def linearise(self, state: State, weights: Tensor) -> tuple[Tensor, State]:
        """Return the cost, half of its Gauss-Newton Hessian, and half of its gradient."""
        r, J = self.sampson(compose(*state)), self.jacobian(state)
        weighted = J * weights[..., None, :]
        return (weights * r.square()).sum(dim=-1), (weighted @ J.mT, (weighted @ r[..., None])[..., 0])

    def differentiate(self, state: State, active: Tensor) -> State:
        """Return the optimum ``state`` of the active pairs with its derivatives attached."""

        def gradient(x: Tensor, problem: EpipolarProblem) -> Tensor:
            return problem.linearise(_move(state, x), problem.weights * active)[1][1]

        constant = EpipolarProblem(*(each.detach() for each in self))
        zero = state[0].new_zeros(*state[0].shape[:-2], 5)
        H = _regularise(jacobian(lambda x: gradient(x, constant), zero))
        problem = EpipolarProblem(*map(without_second_derivatives, self))
        return _move(state, zero_with_gradient(-torch.linalg.solve(H, gradient(zero, problem))))


def _length(line_a: Tensor, line_b: Tensor) -> Tensor:
    """Denominator of the Sampson distance, (..., N), from the epipolar lines in both images, (..., N, 3)."""
    square = line_a[..., :2].square().sum(dim=-1) + line_b[..., :2].square().sum(dim=-1)
    return square.clamp(min=1e-30).sqrt()


def _regularise(H: Tensor) -> Tensor:
    return H + REGULARISATION * torch.eye(5, dtype=H.dtype, device=H.device)


def _step(state: State, system: State, damping: Tensor) -> State:
    H, gradient = system
    damped = _regularise(H + torch.diag_embed(H.diagonal(dim1=-2, dim2=-1) * damping[..., None]))
    return _move(state, -torch.linalg.solve(damped, gradient))


def _minimise_compiled(
    U: Tensor, V: Tensor, K_inverse: Tensor, a: Tensor, b: Tensor, weights: Tensor, valid: Tensor, threshold: float
) -> tuple[Tensor, ...]:
    batch = U.shape[:-2]
    settings = threshold, _ROUNDS, _ITERATIONS, _TOLERANCE, REGULARISATION, DAMPING_SCHEDULE
    columns = U, V, K_inverse, a, b, weights, valid
    arguments: tuple[Any, ...] = (*(to_rows(column, batch) for column in columns), *settings)
    results = kernels.refine_essential(*arguments)
    return tuple(torch.from_numpy(each).reshape(*batch, *each.shape[1:]) for each in results)


@compiled_by(_minimise_compiled)
def _minimise(
    U: Tensor, V: Tensor, K_inverse: Tensor, a: Tensor, b: Tensor, weights: Tensor, valid: Tensor, threshold: float
) -> tuple[Tensor, ...]:
    """Refine essential matrices; return U, V, their inliers (..., N), and the pairs (..., N) of the last round."""
    problem, state, active = EpipolarProblem(a, b, K_inverse, weights), (U, V), valid
    inliers = valid & (problem.sampson(compose(*state)).abs() <= threshold)
    finished = torch.zeros(U.shape[:-2], dtype=torch.bool, device=U.device)
    for _ in range(_ROUNDS):
        active = select(finished, active, inliers)
        linearise = partial(problem.linearise, weights=weights * active)
        state = levenberg_marquardt(state, linearise, _step, _ITERATIONS, _TOLERANCE, finished).state
        inliers = valid & (problem.sampson(compose(*state)).abs() <= threshold)
        finished = finished | (inliers == active).all(dim=-1)
        if is_all_true(finished):
            break
    return *state, inliers, active


def refine_essential(
    E: Tensor, problem: EpipolarProblem, valid: Tensor, threshold: float
) -> tuple[State, Tensor, Tensor]:
    """Refine essential matrices; return the optimum, its inliers (..., N), and the pairs (..., N) of the last round."""
    a, b, K_inverse, weights = problem
    U, V, inliers, active = _minimise(*decompose(E), K_inverse, a, b, weights, valid, threshold)
    return (U, V), inliers, active
