"""Pose of one camera from landmarks it sees: robust least squares on pixels and depth (paper, Sec. III-E).

The motion-only bundle adjustment of ORB-SLAM2 (Mur-Artal and Tardos, T-RO 2017). The errors (`reprojection`) are those
that the bundle adjustment of the map minimises as well.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.levenberg import huber, levenberg_marquardt
from v3d_torch.lie import rigid, se3_exp
from v3d_torch.odometry.orb import Features

INLIER_LIMIT = 5.991
"""Squared error of (u, v) in sigmas that 95 % of good observations stay below: chi-square with 2 degrees of freedom."""

_LIMIT_WITH_DEPTH = 7.815  # the same for (u, v, 1/z), with 3

_NEAREST = 0.05  # metres: no camera sees nearer; keeps 1/z finite for points that a step puts behind the camera


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Where the camera sees landmarks, and how far away.

    Attributes:
        uv: undistorted pixels, float64, shape :math:`(M, 2)`.
        inverse_depth: of the measured depth along z, 1/m, float64, shape :math:`(M,)`; 0 = not measured.
        pixel_sigma: standard deviation of u and of v, pixels, :math:`(M,)`.
        inverse_depth_sigma: standard deviation of inverse depth, 1/m. Constant, as of the disparity of any stereo or
            structured-light camera: depth itself errs by this times z^2 (Khoshelham and Elberink, Sensors 2012).
    """

    uv: Tensor
    inverse_depth: Tensor
    pixel_sigma: Tensor
    inverse_depth_sigma: float

    @property
    def limit(self) -> Tensor:
        """Squared error in sigmas that 95 % of good observations stay below, :math:`(M,)`."""
        return torch.full_like(self.inverse_depth, INLIER_LIMIT).masked_fill_(self.inverse_depth > 0, _LIMIT_WITH_DEPTH)


def pixel_sigma(octave: Tensor, config: TrackingConfig, pyramid: FeaturesConfig) -> Tensor:
    """Standard deviation of a feature's place, pixels: it is as sure as its level of the scale pyramid is fine."""
    return config.pixel_sigma * pyramid.scale ** octave.to(torch.float64)


def measurements(features: Features, config: TrackingConfig, pyramid: FeaturesConfig) -> Measurements:
    """Features as measurements."""
    return Measurements(
        uv=features.uv,
        inverse_depth=features.inverse_depth,
        pixel_sigma=pixel_sigma(features.octave, config, pyramid),
        inverse_depth_sigma=config.inverse_depth_sigma,
    )


def reprojection(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """Errors of (u, v, 1/z) in standard deviations.

    Args:
        points: landmark of each observation in the camera frame, metres, float64, shape :math:`(M, 3)`.
        measured: where they were seen.
        camera: intrinsics.

    Returns:
        Shape :math:`(M, 3)`, the third 0 where no depth was measured. In memory the observations come last.
    """
    X, Y, Z = points.unbind(-1)
    w = 1 / Z.clamp(min=_NEAREST)
    u, v = measured.uv.unbind(-1)
    return torch.stack(
        [
            (camera.fx * X * w + camera.cx - u) / measured.pixel_sigma,
            (camera.fy * Y * w + camera.cy - v) / measured.pixel_sigma,
            torch.where(measured.inverse_depth > 0, w - measured.inverse_depth, 0) / measured.inverse_depth_sigma,
        ]
    ).T


def reprojection_jacobian(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """How the errors of `reprojection` change when the camera moves.

    Returns:
        By the left perturbation of ``T_cw``, shape :math:`(M, 3, 6)`. Its first three columns are the Jacobian by
        ``points``. In memory the observations come last.
    """
    X, Y, Z = points.unbind(-1)
    w = 1 / Z.clamp(min=_NEAREST)
    scaled = w / measured.pixel_sigma
    a, b, o = camera.fx * scaled, camera.fy * scaled, torch.zeros_like(w)
    d = torch.where(measured.inverse_depth > 0, w * w, 0) / -measured.inverse_depth_sigma
    ax, by = -a * X * w, -b * Y * w
    # A small motion moves a point p by translation + rotation x p, and a . (rotation x p) = rotation . (p x a). Number
    # by number, so that all observations of one lie side by side: three times as fast as row by row.
    jacobian = torch.stack(
        [
            *(a, o, o),
            *(o, b, o),
            *(ax, by, d),
            *(Y * ax, Y * by - Z * b, Y * d),
            *(Z * a - X * ax, -X * by, -X * d),
            *(-Y * a, X * b, o),
        ]
    )
    return jacobian.unflatten(0, (6, 3)).permute(2, 1, 0)


def chi_square(points: Tensor, residuals: Tensor) -> Tensor:
    """Squared error of each observation in sigmas, :math:`(M,)`; infinite for points that are not in front."""
    return torch.where(points[:, 2] > _NEAREST, (residuals * residuals).sum(dim=-1), torch.inf)


@dataclass(frozen=True)
class PoseRefinement:
    """A pose and what supports it.

    Attributes:
        T_cw: world to camera, float64, shape :math:`(4, 4)`.
        inliers: observations that agree with it, bool, shape :math:`(N,)`.
        chi2: squared error of each in sigmas, float64, shape :math:`(N,)`; infinite behind the camera.
        information: inverse covariance of the pose's left perturbation, float64, shape :math:`(6, 6)`.
    """

    T_cw: Tensor
    inliers: Tensor
    chi2: Tensor
    information: Tensor


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

    def linearise(T_cw: Tensor, kept: Tensor, limit: Tensor | float) -> tuple[float, _Errors]:
        in_camera = points @ T_cw[:3, :3].T + T_cw[:3, 3]
        residuals = reprojection(in_camera, measured, camera)
        costs, weights = huber((residuals * residuals).sum(dim=-1), limit)
        return float((costs * kept).sum()), _Errors(in_camera, residuals, weights * kept)

    def normal_equations(at: _Errors) -> tuple[Tensor, Tensor]:
        J = reprojection_jacobian(at.in_camera, measured, camera).permute(2, 1, 0).flatten(1)  # as it lies in memory
        weighted = J * at.weights.repeat(3)
        return weighted @ J.T, weighted @ at.residuals.T.flatten()

    def step(T_cw: Tensor, at: _Errors, damping: float) -> Tensor:
        H, gradient = normal_equations(at)
        diagonal = damping * H.diagonal() + 1e-9  # solvable even where nothing is seen
        return se3_exp(-torch.linalg.solve(H + diagonal.diag(), gradient)) @ T_cw

    inliers = torch.ones(points.shape[0], dtype=torch.bool)
    for turn in range(rounds):
        robust = 2 * turn < rounds
        problem = partial(linearise, kept=inliers, limit=measured.limit if robust else torch.inf)
        # Convergence is quadratic: after a step that gained a thousandth nothing worth a step is left.
        found = levenberg_marquardt(T_cw, problem, step, iterations, tolerance=1e-3)
        T_cw, before = found.state, inliers
        chi2 = chi_square(found.system.in_camera, found.system.residuals)
        inliers = chi2 <= measured.limit
        if not robust and torch.equal(inliers, before):
            break
    return PoseRefinement(rigid(T_cw), inliers, chi2, normal_equations(found.system)[0])


@dataclass(frozen=True)
class _Errors:
    in_camera: Tensor  # (M, 3), metres
    residuals: Tensor  # (M, 3), sigmas
    weights: Tensor  # (M,), 0 for outliers
