"""Pose of one camera from landmarks it sees: robust least squares on pixels and depth (paper, Sec. III-E).

The motion-only bundle adjustment of ORB-SLAM2 (Mur-Artal and Tardos, T-RO 2017). The errors (`reprojection`) are those
that the bundle adjustment of the map minimises as well.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import rigid, se3_exp
from v3d_torch.optim.levenberg_marquardt import huber, levenberg_marquardt
from v3d_torch.optim.reprojection import Measurements, chi_square, perspective, perspective_jacobian, whitened


@dataclass(frozen=True)
class _View:
    """A camera's pose, and the errors there. The N observations come last."""

    T_cw: Tensor  # (4, 4)
    in_camera: Tensor  # (3, N), metres
    seen: Tensor  # (3, N), as `perspective` gives it
    errors: Tensor  # (3, N), sigmas
    squared: Tensor  # (N,)


@dataclass(frozen=True)
class PoseRefinement:
    """A pose and what supports it.

    Attributes:
        T_cw: world to camera, float64, shape :math:`(4, 4)`.
        inliers: observations that agree with it, bool, shape :math:`(N,)`.
        chi2: squared error of each in sigmas, float64, shape :math:`(N,)`; infinite behind the camera.
    """

    T_cw: Tensor
    inliers: Tensor
    chi2: Tensor
    _system: Callable[[], tuple[Tensor, Tensor]]

    @property
    def information(self) -> Tensor:
        """Inverse covariance of the pose's left perturbation, float64, shape :math:`(6, 6)`."""
        return self._system()[0]


@torch.no_grad()
def refine_pose(
    T_cw: Tensor,
    points: Tensor,
    measured: Measurements,
    camera: PinholeCamera,
    *,
    rounds: int = 4,
    iterations: int = 5,
) -> PoseRefinement:
    """Refine a predicted pose; observations are judged inliers or outliers anew after each round.

    Args:
        T_cw: predicted world-to-camera pose, shape :math:`(4, 4)`.
        points: landmarks, world frame, metres, float64, shape :math:`(N, 3)`.
        measured: where each is seen.
        camera: intrinsics.
        rounds: of optimisation and judgement; Huber's kernel guards the first half, the rest polishes the inliers.
        iterations: most steps in a round.

    Returns:
        The pose; the prediction itself, without inliers, where nothing supports any pose.
    """
    target, limits = whitened(measured, camera), measured.limit

    def view(T_cw: Tensor) -> _View:
        in_camera = torch.addmm(T_cw[:3, 3:], T_cw[:3, :3], points.T)
        seen = perspective(in_camera)
        errors = target.errors(seen)
        return _View(T_cw, in_camera, seen, errors, (errors * errors).sum(dim=0))

    def weigh(at: _View, kept: Tensor, limit: Tensor | float) -> tuple[float, Tensor]:
        costs, weights = huber(at.squared, limit)
        return float(costs @ kept), weights * kept

    def normal_equations(at: _View, weights: Tensor) -> tuple[Tensor, Tensor]:
        J, weighted = perspective_jacobian(at.seen).flatten(1), weights * target.scale
        return (J * (weighted * target.scale).flatten()) @ J.T, J @ (weighted * at.errors).flatten()

    def step(at: _View, weights: Tensor, damping: float) -> _View:
        H, gradient = normal_equations(at, weights)
        H.diagonal().mul_(1 + damping).add_(1e-9)  # solvable even where nothing is seen
        return view(se3_exp(-torch.linalg.solve(H, gradient)) @ at.T_cw)

    at, inliers = view(T_cw), torch.ones(points.shape[0], dtype=torch.bool)
    for turn in range(rounds):
        robust = 2 * turn < rounds
        problem = partial(weigh, kept=inliers.to(points.dtype), limit=limits if robust else torch.inf)
        # Convergence is quadratic: after a step that gained a thousandth nothing worth a step is left.
        found = levenberg_marquardt(at, problem, step, iterations, tolerance=1e-3)
        at, before = found.state, inliers
        chi2 = chi_square(at.in_camera.T, at.errors.T)
        inliers = chi2 <= limits
        if not robust and torch.equal(inliers, before):
            break
    return PoseRefinement(rigid(at.T_cw), inliers, chi2, partial(normal_equations, at, found.system))
