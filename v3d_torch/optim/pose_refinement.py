"""Motion-only bundle adjustment: the pose of one camera from landmarks and their measurements (paper, Sec. III-E).

Robust least squares on whitened pixel and inverse-depth residuals (`v3d_torch.optim.reprojection`), as in ORB-SLAM2
(Mur-Artal and Tardos, T-RO 2017). The bundle adjustment of the map minimises the same residuals.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from v3d_torch.geometry.argument_checks import check_counts, check_masks, check_positive
from v3d_torch.geometry.gradients import needs_gradient, without_second_derivatives, zero_with_gradient
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.geometry.se3 import orthonormalise, se3_exp
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import pose_refinement as kernels
from v3d_torch.kernels.compiler import compiled_by, is_all_true
from v3d_torch.optim.implicit import jacobian
from v3d_torch.optim.levenberg_marquardt import (
    DAMPING_SCHEDULE,
    POSE_TOLERANCE,
    REGULARISATION,
    levenberg_marquardt,
    select,
)
from v3d_torch.optim.reprojection import (
    INVERSE_DEPTH_SIGMA,
    MIN_DEPTH,
    Measurements,
    WhitenedMeasurements,
    chi_square,
    perspective,
    perspective_jacobian,
    prepare_measurements,
    whiten,
)
from v3d_torch.optim.robust_losses import huber
from v3d_torch.runtime.batches import (
    check_camera_matrix,
    check_shapes,
    fill_padding,
    fill_weights,
    to_rows,
)

ITERATIONS = 5
"""Default maximum number of Levenberg-Marquardt steps in a round."""


class PoseRefinement(NamedTuple):
    """Result of a pose refinement.

    Attributes:
        T_cw: World-to-camera poses, shape :math:`(*, 4, 4)`.
        inliers: Mask of the measurements below their chi-square threshold, bool, shape :math:`(*, N)`.
        chi2: Squared whitened residual of each measurement, shape :math:`(*, N)`; infinite for landmarks behind the
            camera, and for padding.
        information: Information matrix (inverse covariance) of the left perturbation of the pose, shape
            :math:`(*, 6, 6)`.
    """

    T_cw: Tensor
    inliers: Tensor
    chi2: Tensor
    information: Tensor


class _Residuals(NamedTuple):
    """A camera pose and the residuals of N measurements there."""

    T_cw: Tensor  # (..., 4, 4)
    in_camera: Tensor  # (..., 3, N), landmarks in the camera frame, metres
    projected: Tensor  # (..., 3, N), as returned by `perspective`
    whitened: Tensor  # (..., 3, N)
    squared: Tensor  # (..., N), sum of squared residuals


class _Problem(NamedTuple):
    """N landmarks measured by one camera; the measurements are whitened."""

    points: Tensor  # (..., N, 3), landmarks in the world frame, metres
    scale: Tensor  # (..., 3, N)
    offset: Tensor  # (..., 3, N)
    thresholds: Tensor  # (..., N), squared residual at which Huber's loss turns linear, and limit of an inlier
    weights: Tensor  # (..., N)
    valid: Tensor  # (..., N), bool

    def residuals_at(self, T_cw: Tensor) -> _Residuals:
        in_camera = T_cw[..., :3, :3] @ self.points.mT + T_cw[..., :3, 3:]
        projected = perspective(in_camera)
        whitened = WhitenedMeasurements(self.scale, self.offset).residuals(projected)
        return _Residuals(T_cw, in_camera, projected, whitened, (whitened * whitened).sum(dim=-2))

    def chi2(self, at: _Residuals) -> Tensor:
        return torch.where(self.valid, chi_square(at.in_camera.mT, at.whitened.mT), torch.inf)

    def robust_cost(self, at: _Residuals, active: Tensor, *, robust: bool) -> tuple[Tensor, Tensor]:
        """Cost of the active measurements, (...), and the weights of all in the normal equations, (..., N)."""
        costs, robust_weights = huber(at.squared, self.thresholds if robust else torch.inf)
        weights = self.weights * active
        return (costs * weights).sum(dim=-1), robust_weights * weights

    def normal_equations(self, at: _Residuals, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Half of the Gauss-Newton Hessian, (..., 6, 6), and half of the gradient, (..., 6), of the cost."""
        J, weighted = perspective_jacobian(at.projected).flatten(-2), weights[..., None, :] * self.scale
        H = (J * (weighted * self.scale).flatten(-2)[..., None, :]) @ J.mT
        return H, (J @ (weighted * at.whitened).flatten(-2)[..., None])[..., 0]

    def step(self, at: _Residuals, weights: Tensor, damping: Tensor) -> _Residuals:
        H, gradient = self.normal_equations(at, weights)
        damped = H + torch.diag_embed(H.diagonal(dim1=-2, dim2=-1) * damping[..., None] + REGULARISATION)
        return self.residuals_at(se3_exp(-torch.linalg.solve(damped, gradient)) @ at.T_cw)

    def differentiate(self, T_cw: Tensor, active: Tensor, *, robust: bool) -> Tensor:
        """Return the optimum ``T_cw`` of the active measurements, with derivatives.

        They are those with respect to the points, the measurements and the weights.
        """

        def gradient(xi: Tensor, problem: _Problem) -> Tensor:
            at = problem.residuals_at(se3_exp(xi) @ T_cw)
            return problem.normal_equations(at, problem.robust_cost(at, active, robust=robust)[1])[1]

        zero = T_cw.new_zeros(*T_cw.shape[:-2], 6)
        H = jacobian(partial(gradient, problem=self.detach()), zero)
        H = H + REGULARISATION * torch.eye(6, dtype=H.dtype, device=H.device)
        step = -torch.linalg.solve(H, gradient(zero, _Problem(*map(without_second_derivatives, self))))
        return se3_exp(zero_with_gradient(step)) @ T_cw

    def expand(self, batch: torch.Size) -> _Problem:
        dimensions = (2, 2, 2, 1, 1, 1)  # of each column, without those of the batch
        columns = zip(self, dimensions, strict=True)
        return _Problem(*(column.expand(*batch, *column.shape[column.ndim - count :]) for column, count in columns))

    def detach(self) -> _Problem:
        return _Problem(*(column.detach() for column in self))


def refine_pose(
    T_cw: Tensor,
    points: Tensor,
    uv: Tensor,
    K: Tensor,
    inverse_depth: Tensor | None = None,
    pixel_sigma: Tensor | float = 1.0,
    inverse_depth_sigma: Tensor | float = INVERSE_DEPTH_SIGMA,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    rounds: int = 4,
    iterations: int = ITERATIONS,
    tolerance: float = POSE_TOLERANCE,
) -> PoseRefinement:
    r"""Refine predicted poses, and classify the measurements into inliers and outliers.

    Each pose minimises the weighted robust reprojection errors of its landmarks,

    .. math::
        \sum_k w_k\, \rho\left( \frac{\|u_k - \pi(T_{cw} X_k)\|^2}{\sigma_k^2}
            + \frac{(1 / z_k - 1 / \hat z_k)^2}{\sigma_d^2} \right)

    in rounds: each round optimises the pose on the current inliers, then classifies all measurements again. The first
    half of the rounds uses Huber's loss; the other half uses plain least squares. With one round, the pose is the
    robust optimum of all measurements.

    The result is differentiable in all inputs except the prediction, by the implicit function theorem: memory does
    not grow with the iterations. The Hessian is that of the robust cost of the last round, including the dependence of
    the robust weights on the residuals. The classification is constant. The derivatives are as accurate as the optimum:
    train with a small ``tolerance`` and enough ``iterations``. There are no second derivatives: autograd raises an
    InputError, and those of `torch.func` are not correct.

    Mur-Artal and Tardos, ORB-SLAM2, T-RO 2017, Sec. III-C; Gould et al., On Differentiating Parameterized Argmin and
    Argmax Problems, 2016.

    Args:
        T_cw: Predicted world-to-camera poses, shape :math:`(*, 4, 4)`. All inputs are floating point and converted to
            float64. A pose whose prediction is not finite has no inliers, and is not finite.
        points: Landmark of each measurement, world frame, metres, shape :math:`(*, N, 3)`.
        uv: Measured pixels, undistorted, shape :math:`(*, N, 2)`.
        K: Camera matrix, shape :math:`(*, 3, 3)`; its skew is ignored.
        inverse_depth: Inverse of the measured depth, 1/m, shape :math:`(*, N)`; 0, NaN or infinite = not measured.
            None if no depth was measured.
        pixel_sigma: Standard deviation of u and of v, pixels, a number or shape :math:`(*, N)`.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m, a number or shape :math:`(*, N)`.
        weights: Weight of each measurement, not negative, shape :math:`(*, N)`; None for 1.
        valid: Mask of the measurements that are not padding, bool, shape :math:`(*, N)`; None for all. A measurement
            whose landmark or pixel is not finite counts as padding.
        rounds: Maximum number of rounds, at least 1.
        iterations: Maximum number of Levenberg-Marquardt steps in a round.
        tolerance: Relative change of the cost that ends a round.

    Returns:
        The refined poses and their inliers, with the dtype of ``T_cw``, float32 for integers; chi2 and information at
        least in float32. A pose without measurements is the prediction.

    Raises:
        InputError: If ``valid`` is not bool, if a weight is negative, infinite or NaN, if a standard deviation in a
            tensor is not positive, or if ``K`` is not finite, or has a focal length that is not positive or a last row
            other than (0, 0, 1). Values are checked only if they can be read at once.
        ConfigError: If ``rounds``, or a standard deviation that is a number, is not positive, if ``iterations`` is
            negative, or if ``rounds`` or ``iterations`` is not a whole number.

    Example:
        Learn the weights of features through the poses of 32 frames:

        >>> import torch, v3d_torch as v3d
        >>> T_cw, K = torch.eye(4).repeat(32, 1, 1), torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> points = torch.rand(32, 50, 3) * 2 + torch.tensor([-1.0, -1.0, 2.0])
        >>> quality = torch.rand(32, 50, 1)  # a known property of each feature
        >>> noise = 5 * (1 - quality) * torch.randn(32, 50, 2)
        >>> uv = 500 * points[..., :2] / points[..., 2:] + K[:2, 2] + noise
        >>> network = torch.nn.Sequential(torch.nn.Linear(1, 1), torch.nn.Softplus())
        >>> optimiser = torch.optim.Adam(network.parameters(), lr=0.1)
        >>> for _ in range(10):
        ...     refined = v3d.refine_pose(T_cw, points, uv, K, weights=network(quality)[..., 0], rounds=1)
        ...     loss = v3d.se3_log(refined.T_cw).square().sum()  # the true poses are the identity
        ...     optimiser.zero_grad()
        ...     loss.backward()
        ...     optimiser.step()
    """
    check_masks(valid=valid)
    _check_limits(rounds, iterations)
    batch = check_shapes(
        T_cw=(T_cw, 4, 4),
        points=(points, "N", 3),
        uv=(uv, "N", 2),
        K=(K, 3, 3),
        inverse_depth=(inverse_depth, "N"),
        pixel_sigma=(pixel_sigma, None),
        inverse_depth_sigma=(inverse_depth_sigma, None),
        weights=(weights, "N"),
        valid=(valid, "N"),
    )
    check_camera_matrix(K)
    finite = points.isfinite().all(dim=-1) & uv.isfinite().all(dim=-1)  # others would make every step NaN
    exists = T_cw.detach().isfinite().all(dim=-1).all(dim=-1)  # NaN would reach the gradients of other poses
    valid = (finite if valid is None else finite & valid) & exists[..., None]
    weights = fill_weights(weights, valid)
    measured = prepare_measurements(uv, inverse_depth, pixel_sigma, inverse_depth_sigma, valid)
    scale, offset = whiten(measured, K.to(torch.float64))
    problem = _Problem(
        points=fill_padding(points, valid[..., None], 0.0),
        scale=scale,
        offset=offset,
        thresholds=measured.chi2_threshold,
        weights=weights,
        valid=valid,
    )
    initial, dtype = T_cw.detach().to(torch.float64), result_dtype(T_cw.dtype)
    exists = exists[..., None, None]
    initial = torch.where(exists, initial, torch.eye(4, dtype=torch.float64, device=initial.device))
    if batch:
        initial, problem = initial.expand(*batch, 4, 4), problem.expand(batch)
    minimise = partial(_minimise, initial, rounds=rounds, iterations=iterations, tolerance=tolerance)
    if not needs_gradient(*problem):
        found = minimise(*problem)[0]
        return _cast(found._replace(T_cw=torch.where(exists, found.T_cw, torch.nan)), dtype)
    found, active = minimise(*problem.detach())
    robust = _is_robust(rounds - 1, rounds)
    at = problem.residuals_at(problem.differentiate(found.T_cw, active, robust=robust))
    information, _ = problem.normal_equations(at, problem.robust_cost(at, active, robust=robust)[1])
    refined = torch.where(exists, at.T_cw, torch.nan)
    return _cast(PoseRefinement(refined, found.inliers, problem.chi2(at), information), dtype)


def refine_pose_unchecked(
    T_cw: Tensor, points: Tensor, measured: Measurements, K: Tensor, *, rounds: int
) -> PoseRefinement:
    """Refine one pose from measurements that are known to be valid: `refine_pose` without checks and gradients.

    Args:
        T_cw: Predicted world-to-camera pose, float64, shape :math:`(4, 4)`.
        points: Landmark of each measurement, world frame, metres, finite, float64, shape :math:`(N, 3)`.
        measured: Measurements, finite, float64, with a standard deviation for each.
        K: Camera matrix without skew, float64, shape :math:`(3, 3)`.
        rounds: Maximum number of rounds, at least 1.
    """
    (scale, offset), thresholds = whiten(measured, K), measured.chi2_threshold
    weights, valid = torch.ones_like(thresholds), torch.ones_like(thresholds, dtype=torch.bool)
    columns = _Problem(points, scale, offset, thresholds, weights, valid)
    return _minimise(T_cw, *columns, rounds=rounds, iterations=ITERATIONS, tolerance=POSE_TOLERANCE)[0]


def _check_limits(rounds: int, iterations: int) -> None:
    check_positive(rounds=rounds)
    check_counts(rounds=rounds, iterations=iterations)


def _is_robust(index: int, rounds: int) -> bool:
    """Check whether a round uses Huber's loss: the first half of the rounds does."""
    return 2 * index < rounds


def _cast(refined: PoseRefinement, dtype: torch.dtype) -> PoseRefinement:
    if refined.T_cw.dtype == dtype:
        return refined
    wide = working_dtype(dtype)  # information exceeds the range of half precision
    return PoseRefinement(refined.T_cw.to(dtype), refined.inliers, refined.chi2.to(wide), refined.information.to(wide))


def _minimise_compiled(
    T_cw: Tensor, *problem: Tensor, rounds: int, iterations: int, tolerance: float
) -> tuple[PoseRefinement, Tensor]:
    batch, settings = T_cw.shape[:-2], (rounds, iterations, tolerance, REGULARISATION, MIN_DEPTH, DAMPING_SCHEDULE)
    arguments: tuple[Any, ...] = (*(to_rows(column, batch) for column in (T_cw, *problem)), *settings)
    results = kernels.refine_poses(*arguments)
    T, inliers, active, chi2, H = (torch.from_numpy(each).reshape(*batch, *each.shape[1:]) for each in results)
    return PoseRefinement(orthonormalise(T), inliers, chi2, H), active


@torch.no_grad()
@compiled_by(_minimise_compiled)
def _minimise(
    T_cw: Tensor, *columns: Tensor, rounds: int, iterations: int, tolerance: float
) -> tuple[PoseRefinement, Tensor]:
    """Refine poses of a `_Problem`; return them and the mask of measurements used in the last round, bool, (..., N)."""
    problem = _Problem(*columns)
    at, inliers, active = problem.residuals_at(T_cw), problem.valid, problem.valid
    finished = torch.zeros(T_cw.shape[:-2], dtype=torch.bool, device=T_cw.device)
    for index in range(rounds):
        active, robust = select(finished, active, inliers), _is_robust(index, rounds)
        cost = partial(problem.robust_cost, active=active, robust=robust)
        result = levenberg_marquardt(at, cost, problem.step, iterations, tolerance, finished)
        at, previous, inliers = result.state, inliers, problem.chi2(result.state) <= problem.thresholds
        if not robust:
            finished = finished | (inliers == previous).all(dim=-1)
        if is_all_true(finished):
            break
    information, _ = problem.normal_equations(at, result.system)
    return PoseRefinement(orthonormalise(at.T_cw), inliers, problem.chi2(at), information), active


class PoseRefiner(SettingsModule):
    """:func:`refine_pose` as a module. Standard deviations that are a `torch.nn.Parameter` can be learned.

    Args:
        pixel_sigma: Standard deviation of u and of v, pixels.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m.
        rounds: Maximum number of rounds, at least 1.
        iterations: Maximum number of Levenberg-Marquardt steps in a round.
        tolerance: Relative change of the cost that ends a round.

    Raises:
        ConfigError: If a number is not possible; see :func:`refine_pose`.
    """

    def __init__(
        self,
        pixel_sigma: Tensor | float = 1.0,
        inverse_depth_sigma: Tensor | float = INVERSE_DEPTH_SIGMA,
        *,
        rounds: int = 4,
        iterations: int = ITERATIONS,
        tolerance: float = POSE_TOLERANCE,
    ) -> None:
        check_positive(pixel_sigma=pixel_sigma, inverse_depth_sigma=inverse_depth_sigma)
        _check_limits(rounds, iterations)
        super().__init__()
        self.pixel_sigma = pixel_sigma
        self.inverse_depth_sigma = inverse_depth_sigma
        self.rounds = rounds
        self.iterations = iterations
        self.tolerance = tolerance

    def forward(
        self,
        T_cw: Tensor,
        points: Tensor,
        uv: Tensor,
        K: Tensor,
        inverse_depth: Tensor | None = None,
        weights: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> PoseRefinement:
        """Refine poses :math:`(*, 4, 4)` by landmarks :math:`(*, N, 3)` at pixels :math:`(*, N, 2)`.

        See :func:`refine_pose`.
        """
        return refine_pose(
            T_cw,
            points,
            uv,
            K,
            inverse_depth,
            pixel_sigma=self.pixel_sigma,
            inverse_depth_sigma=self.inverse_depth_sigma,
            weights=weights,
            valid=valid,
            rounds=self.rounds,
            iterations=self.iterations,
            tolerance=self.tolerance,
        )
