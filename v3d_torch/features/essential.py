r"""Essential matrices between two views, by RANSAC and refinement of the Sampson distance.

With the normalised coordinates :math:`x_a, x_b` of a point in both images, :math:`x_b^\top E\, x_a = 0`, where
:math:`E = [t]_\times R` for the motion :math:`T_{ba} = (R, t)`.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import kornia_rs
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor

from v3d_torch.features.sampling import ITERATIONS, find_best_hypothesis, gather_samples
from v3d_torch.geometry.se3 import hat, se3_exp
from v3d_torch.kernels.compiler import can_read, is_all_true
from v3d_torch.optim.implicit import jacobian, needs_gradient, zero_with_gradient
from v3d_torch.optim.levenberg_marquardt import levenberg_marquardt, select
from v3d_torch.optim.reprojection import fill_padding

_MIN_PAIRS = 6
"""A sample of 5 pairs, and one more pair that can confirm its matrix."""

_ROUNDS = 3
"""Rounds of refinement on the inliers, after each of which all pairs are classified anew."""

_ITERATIONS, _TOLERANCE = 10, 1e-6
"""Maximum number of steps in a round, and relative change of the cost that ends it."""

_REGULARISATION = 1e-9
"""Added to the diagonal of the normal equations, which are singular without inliers."""


class EssentialMatrix(NamedTuple):
    """Essential matrices found by RANSAC.

    Attributes:
        E: Essential matrices, of unit Frobenius norm, shape :math:`(*, 3, 3)`; 0 if none was found.
        inliers: Mask of the pairs that satisfy the epipolar constraint, bool, shape :math:`(*, N)`.
        found: True if a matrix was found, bool, shape :math:`(*)`.
    """

    E: Tensor
    inliers: Tensor
    found: Tensor


def essential_ransac(
    uv_a: Tensor,
    uv_b: Tensor,
    K: Tensor,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    threshold: float = 1.0,
    iterations: int = ITERATIONS,
    seed: int = 0,
) -> EssentialMatrix:
    """Estimate essential matrices from pairs of pixels: RANSAC, refined by the Sampson distance of all inliers.

    The matrices are differentiable in pixels, camera matrix and weights, by the implicit function theorem; the inliers
    are constant. On the CPU, kornia-rs finds the hypotheses by the five-point algorithm, one problem of the batch after
    the other. On other devices and where `torch.func` traces the computation, torch finds them by the eight-point
    algorithm, all at once; that algorithm does not work if all points lie in a plane.

    `kornia.geometry.motion_from_essential_choose_solution` gives the motion, up to the length of its translation.

    Nister, An Efficient Solution to the Five-Point Relative Pose Problem, PAMI 2004; Hartley and Zisserman, Multiple View
    Geometry, 2004, Sec. 9.6 and 11.4.

    Args:
        uv_a: Undistorted pixels in image a, floating point, shape :math:`(*, N, 2)`.
        uv_b: Undistorted pixels of the same points in image b, shape :math:`(*, N, 2)`.
        K: Camera matrix of both images, shape :math:`(*, 3, 3)`.
        weights: Weight of each pair in the refinement, not negative, shape :math:`(*, N)`; 1 by default.
        valid: Pairs that are not padding, bool, shape :math:`(*, N)`; all by default.
        threshold: Maximum Sampson distance of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.

    Returns:
        Matrices with the dtype of ``uv_a``; their sign is arbitrary. No matrix is found from fewer than 6 pairs.
    """
    KORNIA_CHECK_SHAPE(uv_a, ["*", "N", "2"])
    KORNIA_CHECK_SHAPE(uv_b, ["*", str(uv_a.shape[-2]), "2"])
    KORNIA_CHECK_SHAPE(K, ["*", "3", "3"])
    batch = torch.broadcast_shapes(uv_a.shape[:-2], uv_b.shape[:-2], K.shape[:-2])
    mask = uv_a.new_ones(*batch, uv_a.shape[-2], dtype=torch.bool) if valid is None else valid.expand(*batch, -1)
    row = None if valid is None else valid[..., None]
    problem = _Problem(
        a=_homogeneous(fill_padding(uv_a, row, 0.0).expand(*batch, -1, 2)),
        b=_homogeneous(fill_padding(uv_b, row, 0.0).expand(*batch, -1, 2)),
        K_inverse=torch.linalg.inv(K.to(torch.float64)).expand(*batch, 3, 3),
        weights=(mask.to(torch.float64) if weights is None else fill_padding(weights, valid, 0.0)).expand(*batch, -1),
    )
    constant = _Problem(*(each.detach() for each in problem))
    with torch.no_grad():
        sample = _sample_five_points if can_read(constant.a) else _sample_eight_points
        hypothesis, found = sample(constant, mask, threshold, iterations, seed)
        found = found & (mask.sum(dim=-1) >= _MIN_PAIRS)
        state, inliers, active = _refine(hypothesis, constant, mask & found[..., None], threshold)
    if needs_gradient(*problem):
        state = problem.differentiate(state, active)
    E = torch.where(found[..., None, None], _compose(*state), 0.0)
    return EssentialMatrix(E.to(uv_a.dtype), inliers, found)


State = tuple[Tensor, Tensor]
"""Rotations U and V, shape :math:`(..., 3, 3)` each, of an essential matrix."""


def _compose(U: Tensor, V: Tensor) -> Tensor:
    """Essential matrices U diag(1, 1, 0) V^T, of unit norm."""
    return 0.5**0.5 * (U[..., :2] @ V[..., :2].mT)


def _decompose(E: Tensor) -> State:
    """Rotations U and V of the essential matrices nearest to E; the third columns do not matter."""
    U, _, Vh = torch.linalg.svd(E)
    rotations = []
    for Q in (U, Vh.mT):
        signs = torch.stack([*torch.ones_like(Q[..., :2, 0]).unbind(-1), torch.linalg.det(Q)], dim=-1)
        rotations.append(Q * signs[..., None, :])
    return rotations[0], rotations[1]


def _move(state: State, x: Tensor) -> State:
    """State moved by (..., 5): rotation of U about three axes, and of V about its first two columns.

    Rotating both about their third columns does not change E.
    """
    U, V = state
    turns = x[..., :3], (V[..., :2] @ x[..., 3:, None])[..., 0]
    R_u, R_v = (se3_exp(torch.cat([torch.zeros_like(turn), turn], dim=-1))[..., :3, :3] for turn in turns)
    return R_u @ U, R_v @ V


class _Problem(NamedTuple):
    """Pairs of pixels in two images."""

    a: Tensor  # (..., N, 3), homogeneous pixels
    b: Tensor  # (..., N, 3)
    K_inverse: Tensor  # (..., 3, 3)
    weights: Tensor  # (..., N)

    def sampson(self, E: Tensor) -> Tensor:
        """Sampson distances, signed, pixels: (..., 3, 3) to (..., N)."""
        F = self.K_inverse.mT @ E @ self.K_inverse
        line_b, line_a = self.a @ F.mT, self.b @ F
        return (line_b * self.b).sum(dim=-1) / _length(line_a, line_b)

    def jacobian(self, state: State) -> Tensor:
        """Derivatives of the Sampson distances by the arguments of `_move`, (..., 5, N)."""
        (U, V), E = state, _compose(*state)
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

    def linearise(self, state: State, influence: Tensor) -> tuple[Tensor, State]:
        """Cost, and halves of its Hessian by Gauss-Newton and of its gradient."""
        r, J = self.sampson(_compose(*state)), self.jacobian(state)
        weighted = J * influence[..., None, :]
        return (influence * r.square()).sum(dim=-1), (weighted @ J.mT, (weighted @ r[..., None])[..., 0])

    def differentiate(self, state: State, active: Tensor) -> State:
        """The optimum ``state`` of the active pairs, with its derivatives."""

        def gradient(x: Tensor, problem: _Problem) -> Tensor:
            return problem.linearise(_move(state, x), problem.weights * active)[1][1]

        constant = _Problem(*(each.detach() for each in self))
        zero = state[0].new_zeros(*state[0].shape[:-2], 5)
        H = _regularise(jacobian(lambda x: gradient(x, constant), zero))
        return _move(state, zero_with_gradient(-torch.linalg.solve(H, gradient(zero, self))))


def _length(line_a: Tensor, line_b: Tensor) -> Tensor:
    """Denominator of the Sampson distance, of the epipolar lines (..., N, 3) in both images, (..., N)."""
    square = line_a[..., :2].square().sum(dim=-1) + line_b[..., :2].square().sum(dim=-1)
    return square.clamp(min=1e-30).sqrt()


def _regularise(H: Tensor) -> Tensor:
    return H + _REGULARISATION * torch.eye(5, dtype=H.dtype, device=H.device)


def _step(state: State, system: State, damping: Tensor) -> State:
    H, gradient = system
    damped = _regularise(H + torch.diag_embed(H.diagonal(dim1=-2, dim2=-1) * damping[..., None]))
    return _move(state, -torch.linalg.solve(damped, gradient))


def _refine(E: Tensor, problem: _Problem, valid: Tensor, threshold: float) -> tuple[State, Tensor, Tensor]:
    """Optimum on the inliers, the inliers (..., N), and the pairs (..., N) that took part in the last round."""
    state, active = _decompose(E), valid
    inliers = valid & (problem.sampson(_compose(*state)).abs() <= threshold)
    finished = torch.zeros(E.shape[:-2], dtype=torch.bool, device=E.device)
    for _ in range(_ROUNDS):
        active = select(finished, active, inliers)
        linearise = partial(problem.linearise, influence=problem.weights * active)
        state = levenberg_marquardt(state, linearise, _step, _ITERATIONS, _TOLERANCE, finished).state
        inliers = valid & (problem.sampson(_compose(*state)).abs() <= threshold)
        finished = finished | (inliers == active).all(dim=-1)
        if is_all_true(finished):
            break
    return state, inliers, active


def _sample_five_points(
    problem: _Problem, valid: Tensor, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Best essential matrices of kornia-rs, (..., 3, 3), and True where there is one, (...)."""
    focal = 1 / problem.K_inverse.diagonal(dim1=-2, dim2=-1)[..., :2].prod(dim=-1).sqrt()
    pairs = torch.cat([(each @ problem.K_inverse.mT)[..., :2] for each in (problem.a, problem.b)], dim=-1)
    E = torch.eye(3, dtype=torch.float64).repeat(*valid.shape[:-1], 1, 1)
    found = torch.zeros(valid.shape[:-1], dtype=torch.bool)
    for row in (valid.sum(dim=-1) >= _MIN_PAIRS).nonzero().tolist():
        index = tuple(row)
        try:
            result = kornia_rs.ransac.essential(
                pairs[index][valid[index]].numpy(),
                threshold=(threshold / float(focal[index])) ** 2,  # kornia-rs compares squared distances
                max_iters=iterations,
                seed=seed,
            )
        except ValueError:  # raised by kornia-rs if no sample gives a model
            continue
        E[index], found[index] = torch.tensor(result.model, dtype=torch.float64).reshape(3, 3), True
    return E, found


def _sample_eight_points(
    problem: _Problem, valid: Tensor, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Best essential matrices of RANSAC in torch, (..., 3, 3), and True where there is one, (...)."""
    a, b = (each @ problem.K_inverse.mT for each in (problem.a, problem.b))

    def solve(samples: Tensor) -> Tensor:
        products = (gather_samples(b, samples)[..., :, None] * gather_samples(a, samples)[..., None, :]).flatten(-2)
        smallest = torch.linalg.eigh(products.mT @ products).eigenvectors[..., 0]
        return _compose(*_decompose(smallest.unflatten(-1, (3, 3))))[..., None, :, :]

    def squared_errors(E: Tensor) -> Tensor:
        return _Problem(*(each[..., None, :, :] for each in problem[:3]), problem.weights).sampson(E).square()

    return find_best_hypothesis(
        solve, squared_errors, valid, size=8, threshold=threshold, iterations=iterations, seed=seed
    )


def _homogeneous(uv: Tensor) -> Tensor:
    return torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1)


class EssentialRANSAC(torch.nn.Module):
    """:func:`essential_ransac` as a module.

    Args:
        threshold: Maximum Sampson distance of an inlier, pixels.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.
    """

    def __init__(self, threshold: float = 1.0, iterations: int = ITERATIONS, seed: int = 0) -> None:
        super().__init__()
        self.threshold = threshold
        self.iterations = iterations
        self.seed = seed

    def forward(
        self,
        uv_a: Tensor,
        uv_b: Tensor,
        K: Tensor,
        weights: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> EssentialMatrix:
        """Estimate matrices from pixels :math:`(*, N, 2)` in two images; see :func:`essential_ransac`."""
        settings = {"threshold": self.threshold, "iterations": self.iterations, "seed": self.seed}
        return essential_ransac(uv_a, uv_b, K, weights, valid, **settings)
