"""Bundle adjustment: keyframe poses and landmarks that explain all observations best (ORB-SLAM2, local mapping).

Levenberg-Marquardt on robust errors in pixels and inverse depth; landmarks are eliminated by the Schur complement
(Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000); what is left, 6 unknowns per pose, is solved densely.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.levenberg import huber, levenberg_marquardt
from v3d_torch.lie import se3_exp
from v3d_torch.odometry.refine import Measurements, chi_square, reprojection, reprojection_jacobian


@dataclass(frozen=True, kw_only=True)
class Observations(Measurements):
    """Measurements, and who sees whom in them.

    Attributes:
        pose: index of the camera, int64, shape :math:`(M,)`.
        point: index of the landmark, int64, shape :math:`(M,)`.
    """

    pose: Tensor
    point: Tensor


@dataclass(frozen=True)
class BundleResult:
    """An adjusted map.

    Attributes:
        T_cw: world to camera, float64, shape :math:`(K, 4, 4)`; fixed poses are as given, to the bit.
        points: world frame, metres, float64, shape :math:`(P, 3)`.
        chi2: squared error of each observation in sigmas, float64, shape :math:`(M,)`; infinite behind the camera.
            Compare with ``observations.limit`` to find outliers.
        cost_before: sum of robust squared errors at the start.
        cost_after: the same at the end.
        iterations: steps tried.
    """

    T_cw: Tensor
    points: Tensor
    chi2: Tensor
    cost_before: float
    cost_after: float
    iterations: int


@dataclass(frozen=True)
class Errors:
    """The errors at some poses and points. In all that follows the observations come last.

    Attributes:
        in_camera: point of each observation in its camera, metres, shape :math:`(3, M)`.
        R: rotations from the world into its camera, shape :math:`(3, 3, M)`.
        residuals: in sigmas, shape :math:`(3, M)`.
        weights: of Huber's kernel, shape :math:`(M,)`.
    """

    in_camera: Tensor
    R: Tensor
    residuals: Tensor
    weights: Tensor


@dataclass(frozen=True)
class NormalEquations:
    r"""Blocks of :math:`J^T W J` and, behind the last column of the square ones, of :math:`J^T W r`.

    Attributes:
        U: pose by pose, for F free poses, shape :math:`(F, 6, 7)`.
        V: point by point, shape :math:`(3, 4, P)`.
        W: point by pose, for each of the N observations by free poses, shape :math:`(3, 6, N)`.
        pose: which of the free poses that is, int64, shape :math:`(N,)`.
        point: which point, int64, shape :math:`(N,)`.
    """

    U: Tensor
    V: Tensor
    W: Tensor
    pose: Tensor
    point: Tensor


State = tuple[Tensor, Tensor]  # T_cw (K, 4, 4), points (P, 3)


@torch.no_grad()
def bundle_adjust(
    T_cw: Tensor,
    points: Tensor,
    observations: Observations,
    camera: PinholeCamera,
    fixed: Tensor,
    iterations: int = 10,
    tolerance: float = 1e-6,
) -> BundleResult:
    """Adjust poses and points together.

    Args:
        T_cw: world-to-camera poses, float64, shape :math:`(K, 4, 4)`.
        points: landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        observations: of the points by the poses.
        camera: intrinsics.
        fixed: poses that stay as they are, bool, shape :math:`(K,)`. Without one the map as a whole may drift.
        iterations: most Levenberg-Marquardt steps.
        tolerance: relative change of the cost that ends them.

    Returns:
        Poses and points at the least robust cost found.
    """
    free = torch.nonzero(~fixed)[:, 0]
    problem = partial(errors_at, observations=observations, camera=camera)
    step = partial(_step, observations=observations, camera=camera, free=free)
    found = levenberg_marquardt((T_cw, points), problem, step, iterations, tolerance)
    T_cw, points = found.state
    chi2 = chi_square(found.system.in_camera.T, found.system.residuals.T)
    return BundleResult(T_cw, points, chi2, found.cost_before, found.cost_after, found.iterations)


def errors_at(state: State, observations: Observations, camera: PinholeCamera) -> tuple[float, Errors]:
    """The robust cost at poses :math:`(K, 4, 4)` and points :math:`(P, 3)`, and what it is the sum of."""
    T_cw, points = state
    T = T_cw[:, :3].flatten(1).T[:, observations.pose].unflatten(0, (3, 4))
    R = T[:, :3]
    in_camera = (R * points.T[:, observations.point]).sum(dim=1) + T[:, 3]
    residuals = reprojection(in_camera.T, observations, camera).T
    costs, weights = huber((residuals * residuals).sum(dim=0), observations.limit)
    return float(costs.sum()), Errors(in_camera, R, residuals, weights)


def normal_equations(
    state: State, errors: Errors, observations: Observations, camera: PinholeCamera, free: Tensor
) -> NormalEquations:
    """Linearise the robust cost.

    Args:
        state: K poses and P points.
        errors: there.
        observations: of the points by the poses.
        camera: intrinsics.
        free: indices of the poses that may move, int64, shape :math:`(F,)`.
    """
    poses, points = map(len, state)
    by_pose = reprojection_jacobian(errors.in_camera.T, observations, camera).permute(2, 1, 0)
    by_point = _inner(errors.R.transpose(0, 1), by_pose[:3].transpose(0, 1))
    residuals = errors.residuals[None]
    V = _inner(by_point * errors.weights, torch.cat([by_point, residuals]))

    row = torch.full((poses,), -1)
    row[free] = torch.arange(len(free))
    pose = row[observations.pose]
    by_free = torch.nonzero(pose >= 0)[:, 0]
    pose, by_pose = pose[by_free], by_pose[..., by_free]
    weighted = by_pose * errors.weights[by_free]
    U = _inner(weighted, torch.cat([by_pose, residuals[..., by_free]]))
    return NormalEquations(
        U=_sum_by(pose, len(free), U).permute(2, 0, 1),
        V=_sum_by(observations.point, points, V),
        W=_inner(by_point[..., by_free], weighted),
        pose=pose,
        point=observations.point[by_free],
    )


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """Sums over the errors of products of derivatives, (A, 3, M) and (B, 3, M) to (A, B, M).

    Error by error: as matrix products of three by three, one for each observation, it takes three times as long.
    """
    total = a[:, None, 0] * b[:, 0]
    return total.addcmul_(a[:, None, 1], b[:, 1]).addcmul_(a[:, None, 2], b[:, 2])


def _sum_by(index: Tensor, count: int, blocks: Tensor) -> Tensor:
    """Sums of those blocks (n, m, N) that have the same index, (n, m, count)."""
    rows = blocks.flatten(0, 1)
    sums = rows.new_zeros(len(rows), count).scatter_add_(1, index.expand(len(rows), -1), rows)
    return sums.unflatten(0, blocks.shape[:2])


def solve_normal_equations(system: NormalEquations, damping: float) -> tuple[Tensor, Tensor]:
    r"""Minimise the quadratic model with :math:`\lambda` times its diagonal added, by the Schur complement.

    With :math:`V = L L^T` and :math:`Y = L^{-1} W`, the points are gone from
    :math:`(U - Y^T Y)\, \xi = -g_{pose} + Y^T L^{-1} g_{point}`.

    Args:
        system: of F poses and P points.
        damping: :math:`\lambda`; keeps directions that nothing observes (a point seen once, without depth) in place.

    Returns:
        Steps of the poses, shape :math:`(F, 6)`, and of the points, shape :math:`(P, 3)`.
    """
    F, P = system.U.shape[0], system.V.shape[-1]
    U, V = _damp(system.U[..., :6].permute(1, 2, 0), damping), _damp(system.V[:, :3], damping)
    L = _cholesky(V)
    h = _forward(L, system.V[:, 3])
    blocks = _forward(L[:, :, system.point], system.W)
    # Y is dense, as a local map is small and most poses see much of it; transposed, so that its blocks lie apart.
    place = (
        (18 * P * system.pose + system.point) + P * torch.arange(3)[:, None, None] + 3 * P * torch.arange(6)[:, None]
    )
    Yt = blocks.new_zeros(18 * F * P).scatter_add_(0, place.flatten(), blocks.flatten()).view(6 * F, 3 * P)
    S = -(Yt @ Yt.T)
    S.view(F, 6, F, 6).diagonal(dim1=0, dim2=2).add_(U)
    xi = torch.linalg.solve(S, Yt @ h.flatten() - system.U[..., 6].flatten())
    moved = _backward(L, -(h + (Yt.T @ xi).view(3, P)))
    return xi.view(F, 6), moved.T


def _damp(blocks: Tensor, damping: float) -> Tensor:
    """Blocks (n, n, count) with more on their diagonals."""
    # Next to information of 1e4 per square metre and more, 1e-6 is nothing; a block that nothing observes needs it.
    blocks = blocks.clone()
    diagonal = blocks.diagonal(dim1=0, dim2=1)
    diagonal.mul_(1 + damping).add_(1e-6)
    return blocks


def _cholesky(V: Tensor) -> Tensor:
    """Lower triangles of positive definite 3x3 blocks, both :math:`(3, 3, P)`: LAPACK takes longer for small ones."""
    L = torch.zeros_like(V)
    for row in range(3):
        for column in range(row + 1):
            rest = V[row, column] - (L[row, :column] * L[column, :column]).sum(dim=0)
            L[row, column] = rest.sqrt() if row == column else rest / L[column, column]
    return L


def _forward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L x = b, block by block, for :math:`(3, 3, N)` and :math:`(3, ..., N)`."""
    x = torch.empty_like(b)
    for row in range(3):
        x[row] = b[row]
        for column in range(row):
            x[row].addcmul_(L[row, column], x[column], value=-1)
        x[row] /= L[row, row]
    return x


def _backward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L^T x = b."""
    return _forward(L.transpose(0, 1).flip(0, 1), b.flip(0)).flip(0)


def _step(
    state: State, errors: Errors, damping: float, observations: Observations, camera: PinholeCamera, free: Tensor
) -> State:
    T_cw, points = state
    xi, moved = solve_normal_equations(normal_equations(state, errors, observations, camera, free), damping)
    T_cw = T_cw.index_copy(0, free, se3_exp(xi) @ T_cw[free])
    return T_cw, points + moved
