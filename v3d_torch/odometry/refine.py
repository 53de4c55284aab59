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


@dataclass(frozen=True)
class Whitened:
    """Measurements as the errors count them: in sigmas, error = ``scale * (x/z, y/z, 1/z) + offset``.

    Attributes:
        scale: float64, shape :math:`(3, M)`; 0 where no depth was measured.
        offset: the same, of what was measured.
    """

    scale: Tensor
    offset: Tensor

    def errors(self, seen: Tensor) -> Tensor:
        """Errors of (u, v, 1/z) in sigmas, of points seen at `perspective`, both :math:`(3, M)`."""
        return torch.addcmul(self.offset, self.scale, seen)


def whitened(measured: Measurements, camera: PinholeCamera) -> Whitened:
    """What makes `perspective` errors. All that is the same wherever the camera is, worked out once."""
    u, v = measured.uv.unbind(-1)
    known, sigma = measured.inverse_depth > 0, measured.pixel_sigma
    inverse_depth = torch.where(known, measured.inverse_depth, 0)
    return Whitened(
        scale=torch.stack([camera.fx / sigma, camera.fy / sigma, known.to(u.dtype) / measured.inverse_depth_sigma]),
        offset=torch.stack(
            [(camera.cx - u) / sigma, (camera.cy - v) / sigma, inverse_depth / -measured.inverse_depth_sigma]
        ),
    )


def perspective(points: Tensor) -> Tensor:
    """(x/z, y/z, 1/z) of points in the camera frame, metres, both :math:`(3, M)`."""
    w = 1 / points[2:].clamp(min=_NEAREST)
    return torch.cat([points[:2] * w, w])


def perspective_jacobian(seen: Tensor) -> Tensor:
    """How `perspective` changes when the camera moves, by the left perturbation of ``T_cw``.

    Args:
        seen: where the points are seen, shape :math:`(3, M)`.

    Returns:
        Derivatives by translation and rotation, shape :math:`(6, 3, M)`.
    """
    constant, linear, turn = (numbers.to(seen.dtype) for numbers in (_CONSTANT, _LINEAR, _TURN))
    jacobian = torch.addmm(constant, linear, seen).unflatten(0, (6, 3))
    jacobian[2:5].addcmul_((turn @ seen)[:, None], seen)
    return jacobian


# With (a, b, w) = (x/z, y/z, 1/z) the derivatives by the six perturbations are the rows
#   (w, 0, 0), (0, w, 0), -w (a, b, w), -b (a, b, w) - (0, 1, 0), a (a, b, w) + (1, 0, 0), (-b, a, 0):
# constant, linear in (a, b, w), and the products of that with (-w, -b, a). So they take three operations.
_CONSTANT, _LINEAR = torch.zeros(6, 3, 1, dtype=torch.float64), torch.zeros(6, 3, 3, dtype=torch.float64)
_CONSTANT[3, 1], _CONSTANT[4, 0] = -1.0, 1.0
_LINEAR[0, 0, 2], _LINEAR[1, 1, 2], _LINEAR[5, 0, 1], _LINEAR[5, 1, 0] = 1.0, 1.0, -1.0, 1.0
_CONSTANT, _LINEAR = _CONSTANT.flatten(0, 1), _LINEAR.flatten(0, 1)
_TURN = torch.tensor([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)


def reprojection(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """Errors of (u, v, 1/z) in standard deviations.

    Args:
        points: landmark of each observation in the camera frame, metres, float64, shape :math:`(M, 3)`.
        measured: where they were seen.
        camera: intrinsics.

    Returns:
        Shape :math:`(M, 3)`, the third 0 where no depth was measured. In memory the observations come last.
    """
    return whitened(measured, camera).errors(perspective(points.T)).T


def reprojection_jacobian(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """How the errors of `reprojection` change when the camera moves.

    Returns:
        By the left perturbation of ``T_cw``, shape :math:`(M, 3, 6)`. Its first three columns are the Jacobian by
        ``points``. In memory the observations come last.
    """
    scale = whitened(measured, camera).scale
    return (perspective_jacobian(perspective(points.T)) * scale).permute(2, 1, 0)


def chi_square(points: Tensor, residuals: Tensor) -> Tensor:
    """Squared error of each observation in sigmas, :math:`(M,)`; infinite for points that are not in front."""
    return torch.where(points[:, 2] > _NEAREST, (residuals * residuals).sum(dim=-1), torch.inf)


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
