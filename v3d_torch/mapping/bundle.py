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
from v3d_torch.odometry.refine import Measurements, chi_square, reprojection


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
class NormalEquations:
    r"""Blocks of :math:`J^T W J` and :math:`J^T W r` for F free poses and P points.

    Attributes:
        U: pose by pose, shape :math:`(F, 6, 6)`.
        V: point by point, shape :math:`(P, 3, 3)`.
        W: point by pose, shape :math:`(P, 3, 6F)`: dense, as a local map is small and most poses see much of it.
        pose_gradient: shape :math:`(6F,)`.
        point_gradient: shape :math:`(P, 3)`.
    """

    U: Tensor
    V: Tensor
    W: Tensor
    pose_gradient: Tensor
    point_gradient: Tensor


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
    problem = partial(normal_equations, observations=observations, camera=camera, free=free)
    found = levenberg_marquardt((T_cw, points), problem, partial(_step, free=free), iterations, tolerance)
    T_cw, points = found.state
    in_camera, _ = _to_camera(T_cw, points, observations)
    chi2 = chi_square(in_camera, reprojection(in_camera, observations, camera)[0])
    return BundleResult(T_cw, points, chi2, found.cost_before, found.cost_after, found.iterations)


def _to_camera(T_cw: Tensor, points: Tensor, observations: Observations) -> tuple[Tensor, Tensor]:
    """The point of each observation in its camera, (M, 3), and the rotation that brought it there, (M, 3, 3)."""
    T = T_cw[observations.pose]
    R = T[:, :3, :3]
    return (R @ points[observations.point, :, None])[..., 0] + T[:, :3, 3], R


def normal_equations(
    state: State, observations: Observations, camera: PinholeCamera, free: Tensor
) -> tuple[float, NormalEquations]:
    """Linearise the robust cost.

    Args:
        state: poses :math:`(K, 4, 4)` and points :math:`(P, 3)`.
        observations: of the points by the poses.
        camera: intrinsics.
        free: indices of the poses that may move, int64, shape :math:`(F,)`.

    Returns:
        Cost, and normal equations with Huber's weights in W.
    """
    T_cw, points = state
    in_camera, R = _to_camera(T_cw, points, observations)
    residuals, by_pose = reprojection(in_camera, observations, camera)
    costs, weights = huber((residuals * residuals).sum(dim=-1), observations.limit)
    by_point = by_pose[..., :3] @ R

    # Fixed poses get a last column of their own, which is cut off at the end.
    F, P = free.shape[0], points.shape[0]
    column = torch.full((T_cw.shape[0],), F)
    column[free] = torch.arange(F)
    pose, point = column[observations.pose], observations.point

    weighted_pose = (by_pose * weights[:, None, None]).mT
    weighted_point = (by_point * weights[:, None, None]).mT
    gradients = residuals[..., None]
    pose_gradient = _sum_by(pose, F + 1, (weighted_pose @ gradients)[..., 0])
    W = _sum_by(point * (F + 1) + pose, P * (F + 1), weighted_point @ by_pose)
    return float(costs.sum()), NormalEquations(
        U=_sum_by(pose, F + 1, weighted_pose @ by_pose)[:F],
        V=_sum_by(point, P, weighted_point @ by_point),
        W=W.unflatten(0, (P, F + 1))[:, :F].transpose(1, 2).flatten(2),
        pose_gradient=pose_gradient[:F].flatten(),
        point_gradient=_sum_by(point, P, (weighted_point @ gradients)[..., 0]),
    )


def _sum_by(index: Tensor, count: int, values: Tensor) -> Tensor:
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, index, values)


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
    F, P = system.U.shape[0], system.V.shape[0]
    L = torch.linalg.cholesky(_damp(system.V, damping))
    right = torch.cat([system.W, system.point_gradient[..., None]], dim=-1)
    right = torch.linalg.solve_triangular(L, right, upper=False).reshape(3 * P, 6 * F + 1)
    Y, h = right[:, :-1], right[:, -1]
    S = -(Y.T @ Y)
    S.view(F, 6, F, 6).diagonal(dim1=0, dim2=2).add_(_damp(system.U, damping).permute(1, 2, 0))
    xi = torch.linalg.solve(S, Y.T @ h - system.pose_gradient)
    moved = torch.linalg.solve_triangular(L.mT, -(h + Y @ xi).reshape(P, 3, 1), upper=True)
    return xi.reshape(F, 6), moved[..., 0]


def _damp(blocks: Tensor, damping: float) -> Tensor:
    # Next to information of 1e4 per square metre and more, 1e-6 is nothing; a block that nothing observes needs it.
    return blocks + torch.diag_embed(damping * blocks.diagonal(dim1=-2, dim2=-1) + 1e-6)


def _step(state: State, system: NormalEquations, damping: float, free: Tensor) -> State:
    T_cw, points = state
    xi, moved = solve_normal_equations(system, damping)
    T_cw = T_cw.index_copy(0, free, se3_exp(xi) @ T_cw[free])
    return T_cw, points + moved
