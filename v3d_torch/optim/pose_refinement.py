"""Motion-only bundle adjustment: the pose of one camera from landmarks and their measurements (paper, Sec. III-E).

Robust least squares on whitened pixel and inverse-depth residuals (`v3d_torch.optim.reprojection`), as in ORB-SLAM2
(Mur-Artal and Tardos, T-RO 2017). The bundle adjustment of the map minimises the same residuals.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import orthonormalise, se3_exp
from v3d_torch.kernels import pose_refinement as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.optim.levenberg_marquardt import DAMPING_SCHEDULE, huber, levenberg_marquardt
from v3d_torch.optim.reprojection import MIN_DEPTH, Measurements, chi_square, perspective, perspective_jacobian, whiten

_TOLERANCE = 1e-3
"""Relative change of the cost at convergence. Gauss-Newton converges quadratically: the next step gains far less."""

_REGULARISATION = 1e-9
"""Added to the diagonal of the normal equations, which are singular without measurements."""


@dataclass(frozen=True)
class _Linearisation:
    """A camera pose and the residuals of N measurements there."""

    T_cw: Tensor  # (4, 4)
    in_camera: Tensor  # (3, N), landmarks in the camera frame, metres
    projected: Tensor  # (3, N), as returned by `perspective`
    residuals: Tensor  # (3, N), whitened
    squared: Tensor  # (N,), sum of squared residuals


@dataclass(frozen=True)
class PoseRefinement:
    """Result of a pose refinement.

    Attributes:
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
        inliers: Mask of the measurements below their chi-square threshold, bool, shape :math:`(N,)`.
        chi2: Squared whitened residual of each measurement, float64, shape :math:`(N,)`; infinite for landmarks behind
            the camera.
    """

    T_cw: Tensor
    inliers: Tensor
    chi2: Tensor
    _information: Callable[[], Tensor]

    @property
    def information(self) -> Tensor:
        """Information matrix (inverse covariance) of the pose's left perturbation, float64, shape :math:`(6, 6)`."""
        return self._information()


def _refine_pose_compiled(
    T_cw: Tensor, points: Tensor, measured: Measurements, camera: PinholeCamera, *, rounds: int = 4, iterations: int = 5
) -> PoseRefinement:
    if T_cw.dtype != torch.float64 or points.dtype != torch.float64 or points.shape[1:] != (3,):
        return NotImplemented
    target = whiten(measured, camera)
    refined = kernels.refine_pose(
        to_array(T_cw),
        to_array(points),
        to_array(target.scale),
        to_array(target.offset),
        to_array(measured.chi2_threshold),
        rounds,
        iterations,
        _TOLERANCE,
        _REGULARISATION,
        MIN_DEPTH,
        DAMPING_SCHEDULE,
    )
    T, inliers, chi2, H = map(torch.from_numpy, refined)
    return PoseRefinement(orthonormalise(T), inliers, chi2, lambda: H)


@torch.no_grad()
@compiled_by(_refine_pose_compiled)
def refine_pose(
    T_cw: Tensor,
    points: Tensor,
    measured: Measurements,
    camera: PinholeCamera,
    *,
    rounds: int = 4,
    iterations: int = 5,
) -> PoseRefinement:
    """Refine a predicted pose, and classify the measurements into inliers and outliers.

    Each round optimises the pose on the current inliers, then classifies all measurements anew. The first half of the
    rounds uses Huber's kernel; the other half uses plain least squares.

    Args:
        T_cw: Predicted world-to-camera pose, float64, shape :math:`(4, 4)`.
        points: Landmark of each measurement, world frame, metres, float64, shape :math:`(N, 3)`.
        measured: Measured pixels and inverse depths of the landmarks.
        camera: Intrinsics.
        rounds: Maximum number of rounds.
        iterations: Maximum number of Levenberg-Marquardt steps in a round.

    Returns:
        The refined pose and its inliers. Without measurements, the prediction.
    """
    target, thresholds = whiten(measured, camera), measured.chi2_threshold

    def linearise(T_cw: Tensor) -> _Linearisation:
        in_camera = torch.addmm(T_cw[:3, 3:], T_cw[:3, :3], points.T)
        projected = perspective(in_camera)
        residuals = target.residuals(projected)
        return _Linearisation(T_cw, in_camera, projected, residuals, (residuals * residuals).sum(dim=0))

    def robust_cost(at: _Linearisation, active: Tensor, threshold: Tensor | float) -> tuple[float, Tensor]:
        costs, weights = huber(at.squared, threshold)
        return float(costs @ active), weights * active

    def normal_equations(at: _Linearisation, weights: Tensor) -> tuple[Tensor, Tensor]:
        J, weighted = perspective_jacobian(at.projected).flatten(1), weights * target.scale
        return (J * (weighted * target.scale).flatten()) @ J.T, J @ (weighted * at.residuals).flatten()

    def step(at: _Linearisation, weights: Tensor, damping: float) -> _Linearisation:
        H, gradient = normal_equations(at, weights)
        H.diagonal().mul_(1 + damping).add_(_REGULARISATION)
        return linearise(se3_exp(-torch.linalg.solve(H, gradient)) @ at.T_cw)

    at, inliers = linearise(T_cw), torch.ones(points.shape[0], dtype=torch.bool)
    for index in range(rounds):
        robust = 2 * index < rounds
        problem = partial(robust_cost, active=inliers.to(points.dtype), threshold=thresholds if robust else torch.inf)
        result = levenberg_marquardt(at, problem, step, iterations, tolerance=_TOLERANCE)
        at, previous = result.state, inliers
        chi2 = chi_square(at.in_camera.T, at.residuals.T)
        inliers = chi2 <= thresholds
        if not robust and torch.equal(inliers, previous):
            break
    return PoseRefinement(orthonormalise(at.T_cw), inliers, chi2, lambda: normal_equations(at, result.system)[0])
