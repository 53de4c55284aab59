"""Bundle adjustment: joint optimisation of keyframe poses and landmarks (ORB-SLAM2, local mapping).

Levenberg-Marquardt minimises robust errors of pixels and inverse depth. Landmarks are eliminated by the Schur
complement (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000); the reduced system, with 6 unknowns per
pose, is solved densely.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.argument_checks import check_counts, check_positive
from v3d_torch.geometry.gradients import needs_gradient
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import bundle_adjustment as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.mapping.bundle_problem import BundleProblem, prepare_bundle
from v3d_torch.optim.levenberg_marquardt import DAMPING_SCHEDULE, levenberg_marquardt
from v3d_torch.optim.reprojection import INVERSE_DEPTH_SIGMA, MIN_DEPTH
from v3d_torch.optim.schur import SCHUR_REGULARISATION
from v3d_torch.runtime.batches import from_rows, to_rows

_Array = NDArray[Any]

SortedProblem = tuple[_Array, _Array, _Array, _Array, _Array, _Array, _Array]
"""Arguments of the kernels: scale, offset, threshold, weight and pose of the observations sorted by point;
first observation of each point; free poses."""


class BundleAdjustment(NamedTuple):
    """Result of a bundle adjustment.

    Attributes:
        T_cw: World-to-camera poses, shape :math:`(*, P, 4, 4)`; fixed poses are bit-identical to the input.
        points: Positions of the landmarks, world frame, metres, shape :math:`(*, L, 3)`.
        inliers: Mask of the observations below their chi-square threshold, bool, shape :math:`(*, M)`.
        chi2: Squared whitened residual of each observation, shape :math:`(*, M)`; infinite for landmarks behind the
            camera, and for padding.
        cost_before: Sum of the weighted robust squared residuals at the start, shape :math:`(*)`.
        cost_after: Sum of the weighted robust squared residuals at the result, shape :math:`(*)`.
        iterations: Number of steps tried, int64, shape :math:`(*)`.
    """

    T_cw: Tensor
    points: Tensor
    inliers: Tensor
    chi2: Tensor
    cost_before: Tensor
    cost_after: Tensor
    iterations: Tensor


def bundle_adjust(
    T_cw: Tensor,
    points: Tensor,
    uv: Tensor,
    pose: Tensor,
    point: Tensor,
    K: Tensor,
    inverse_depth: Tensor | None = None,
    pixel_sigma: Tensor | float = 1.0,
    inverse_depth_sigma: Tensor | float = INVERSE_DEPTH_SIGMA,
    fixed: Tensor | None = None,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    iterations: int = 10,
    tolerance: float = 1e-6,
) -> BundleAdjustment:
    r"""Optimise poses and landmarks jointly.

    .. math::
        \min_{\{T_i\}, \{X_k\}} \sum_{i, k} w_{ik}\, \rho\left( \frac{\|u_{ik} - \pi(T_i X_k)\|^2}{\sigma_{ik}^2}
            + \frac{(1 / z_{ik} - 1 / \hat z_{ik})^2}{\sigma_d^2} \right)

    with Huber's loss :math:`\rho`. The landmarks are eliminated; memory grows with P times L.

    The result is differentiable in all inputs except the initial poses and points, by the implicit function theorem:
    memory does not grow with the iterations. The Hessian is that of the robust cost, including the dependence of the
    robust weights on the residuals. The result is also differentiable in fixed poses. The derivatives are as accurate
    as the optimum: train with a small ``tolerance`` and enough ``iterations``. There are no second derivatives:
    autograd raises an InputError, and those of `torch.func` are not correct.

    Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000; Gould et al., On Differentiating Parameterized Argmin
    and Argmax Problems, 2016.

    Args:
        T_cw: Initial world-to-camera poses, shape :math:`(*, P, 4, 4)`. All inputs are floating point except indices
            and masks, and converted to float64.
        points: Initial positions of the landmarks, world frame, metres, shape :math:`(*, L, 3)`. Poses and landmarks
            that are padding have no observations; they must be finite, and are returned unchanged.
        uv: Observed pixels, undistorted, shape :math:`(*, M, 2)`.
        pose: Index of the pose from which each observation was made, from 0 to P - 1, int64, shape :math:`(*, M)`;
            any index for padding.
        point: Index of the observed landmark, from 0 to L - 1, int64, shape :math:`(*, M)`; any index for padding.
        K: Camera matrix, shape :math:`(*, 3, 3)`; its skew is ignored.
        inverse_depth: Inverse of the measured depth, 1/m, shape :math:`(*, M)`; 0, NaN or infinite = not measured.
            None if no depth was measured.
        pixel_sigma: Standard deviation of u and of v, pixels, a number or shape :math:`(*, M)`.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m, a number or shape :math:`(*, M)`.
        fixed: Mask of the poses that stay unchanged, bool, shape :math:`(*, P)`; None for only the first. Without a
            fixed pose the world frame can drift.
        weights: Weight of each observation, not negative, shape :math:`(*, M)`; None for 1.
        valid: Mask of the observations that are not padding, bool, shape :math:`(*, M)`; None for all. An observation
            whose pixel is not finite counts as padding.
        iterations: Maximum number of Levenberg-Marquardt steps.
        tolerance: Relative change of the cost that ends the optimisation.

    Returns:
        Poses and landmarks with the lowest robust cost found, with the dtypes of ``T_cw`` and of ``points``, float32
        for integers; chi2 and costs at least in float32.

    Raises:
        InputError: If ``pose`` or ``point`` is not int64 or has an index out of range, if a mask is not bool, if a pose
            or landmark is not finite, if a weight is negative, infinite or NaN, if a standard deviation in a tensor is
            not positive, or if ``K`` is not finite, or has a focal length that is not positive or a last row other than
            (0, 0, 1). Values are checked only if they can be read at once.
        ConfigError: If a standard deviation that is a number is not positive, or ``iterations`` is negative or not a
            whole number.
    """
    check_counts(iterations=iterations)
    problem, initial, valid = prepare_bundle(
        T_cw, points, uv, pose, point, K, inverse_depth, pixel_sigma, inverse_depth_sigma, fixed, weights, valid
    )
    start = initial[0].detach(), initial[1].detach()
    if needs_gradient(initial[0], *problem):
        found = _minimise(*start, *problem.detach(), iterations=iterations, tolerance=tolerance)
        state = problem.differentiate((found.T_cw, found.points), initial[0])
        cost_after, residuals = problem.residuals_at(state)
        found = found._replace(T_cw=state[0], points=state[1], chi2=problem.chi2(residuals), cost_after=cost_after)
    else:
        found = _minimise(*start, *problem, iterations=iterations, tolerance=tolerance)
    chi2 = torch.where(valid, found.chi2, torch.inf)
    wide = working_dtype(T_cw.dtype)  # costs can exceed the range of half precision
    return BundleAdjustment(
        # Without a successful step, poses and landmarks are the tensors of the caller.
        T_cw=found.T_cw.to(result_dtype(T_cw.dtype), copy=True),
        points=found.points.to(result_dtype(points.dtype), copy=True),
        inliers=chi2 <= problem.thresholds,
        chi2=chi2.to(wide),
        cost_before=found.cost_before.to(wide),
        cost_after=found.cost_after.to(wide),
        iterations=found.iterations,
    )


class _Minimum(NamedTuple):
    """Solution of a bundle adjustment, as in `BundleAdjustment`, but with finite ``chi2`` for padding."""

    T_cw: Tensor
    points: Tensor
    chi2: Tensor
    cost_before: Tensor
    cost_after: Tensor
    iterations: Tensor


def sort_by_point(problem: BundleProblem, point_count: int) -> Iterator[tuple[NDArray[np.int64], SortedProblem]]:
    """Sort the observations of each problem of a batch by point; yield their order and the arguments of the kernels."""
    batch = problem.fixed.shape[:-1]
    for row in zip(*(to_rows(column, batch) for column in problem), strict=True):
        order = np.argsort(row[5], kind="stable")
        of_points = np.searchsorted(row[5][order], np.arange(point_count + 1))
        # The last dimension is that of the observations.
        yield order, (*(each.take(order, axis=-1) for each in row[:5]), of_points, np.flatnonzero(~row[6]))


def _minimise_compiled(T_cw: Tensor, points: Tensor, *columns: Tensor, iterations: int, tolerance: float) -> _Minimum:
    batch = T_cw.shape[:-3]
    if 0 in batch:
        return NotImplemented
    settings = iterations, tolerance, SCHUR_REGULARISATION, MIN_DEPTH, DAMPING_SCHEDULE
    problems = sort_by_point(BundleProblem(*columns), points.shape[-2])
    results = []
    for T, X, (order, arguments) in zip(to_rows(T_cw, batch), to_rows(points, batch), problems, strict=True):
        *moved, squared, cost_before, cost_after, steps = kernels.bundle_adjust(T, X, *arguments, *settings)
        chi2 = np.empty_like(squared)
        chi2[order] = squared
        results.append((*moved, chi2, cost_before, cost_after, steps))
    return _Minimum(*from_rows(results, batch))


@torch.no_grad()
@compiled_by(_minimise_compiled)
def _minimise(T_cw: Tensor, points: Tensor, *columns: Tensor, iterations: int, tolerance: float) -> _Minimum:
    """Minimise the robust cost of a `BundleProblem`, without gradients."""
    problem = BundleProblem(*columns)
    found = levenberg_marquardt((T_cw, points), problem.residuals_at, problem.step, iterations, tolerance)
    return _Minimum(*found.state, problem.chi2(found.system), found.cost_before, found.cost_after, found.iterations)


class BundleAdjuster(SettingsModule):
    """:func:`bundle_adjust` as a module. Standard deviations that are a `torch.nn.Parameter` can be learned.

    Args:
        pixel_sigma: Standard deviation of u and of v, pixels.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m.
        iterations: Maximum number of Levenberg-Marquardt steps.
        tolerance: Relative change of the cost that ends the optimisation.

    Raises:
        ConfigError: If a number is not possible; see :func:`bundle_adjust`.
    """

    def __init__(
        self,
        pixel_sigma: Tensor | float = 1.0,
        inverse_depth_sigma: Tensor | float = INVERSE_DEPTH_SIGMA,
        *,
        iterations: int = 10,
        tolerance: float = 1e-6,
    ) -> None:
        check_positive(pixel_sigma=pixel_sigma, inverse_depth_sigma=inverse_depth_sigma)
        check_counts(iterations=iterations)
        super().__init__()
        self.pixel_sigma = pixel_sigma
        self.inverse_depth_sigma = inverse_depth_sigma
        self.iterations = iterations
        self.tolerance = tolerance

    def forward(
        self,
        T_cw: Tensor,
        points: Tensor,
        uv: Tensor,
        pose: Tensor,
        point: Tensor,
        K: Tensor,
        inverse_depth: Tensor | None = None,
        fixed: Tensor | None = None,
        weights: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> BundleAdjustment:
        """Adjust poses :math:`(*, P, 4, 4)` and landmarks :math:`(*, L, 3)` to M observations.

        See :func:`bundle_adjust`.
        """
        observed = uv, pose, point, K, inverse_depth, self.pixel_sigma, self.inverse_depth_sigma
        return bundle_adjust(
            T_cw, points, *observed, fixed, weights, valid, iterations=self.iterations, tolerance=self.tolerance
        )
