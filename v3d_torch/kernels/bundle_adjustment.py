"""Kernel of bundle adjustment; see `v3d_torch.mapping.bundle_adjustment` and `v3d_torch.optim.schur`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats, Ints
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.levenberg_marquardt import DampingSchedule, has_converged, next_damping
from v3d_torch.kernels.reprojection import huber, multiply, perspective_jacobian, se3_exp, transform
from v3d_torch.kernels.schur import solve_normal_equations


@device
def _compute_residuals(
    T_cw: Floats, points: Floats, scale: Floats, offset: Floats, thresholds: Floats, weights: Floats, pose: Ints,
    first: Ints, min_depth: float, r: Floats, robust_weights: Floats, chi2: Floats,
) -> float:  # fmt: skip
    """Return the robust cost; write whitened residuals, given weights times those of the loss, and squared errors."""
    cost = 0.0
    for p in range(len(points)):
        for m in range(first[p], first[p + 1]):
            x, y, z = transform(T_cw[pose[m]], points[p, 0], points[p, 1], points[p, 2])
            w = 1 / max(z, min_depth)
            r0, r1 = scale[0, m] * (x * w) + offset[0, m], scale[1, m] * (y * w) + offset[1, m]
            r2 = scale[2, m] * w + offset[2, m]
            squared = r0 * r0 + r1 * r1 + r2 * r2
            robust, weight = huber(squared, thresholds[m])
            cost += weights[m] * robust
            robust_weights[m] = weights[m] * weight
            r[m, 0], r[m, 1], r[m, 2], chi2[m] = r0, r1, r2, squared if z > min_depth else np.inf
    return cost


@device
def _linearise(
    T_cw: Floats, points: Floats, scale: Floats, pose: Ints, first: Ints, row: Ints, min_depth: float,
    r: Floats, robust_weights: Floats, U: Floats, V: Floats, W: Floats,
) -> None:  # fmt: skip
    """Write the blocks of the normal equations; the last columns of U and V are gradients, W is for free poses only."""
    U[:], V[:] = 0.0, 0.0
    J = np.empty((3, 10))  # derivatives of a residual with respect to pose and point, and the residual
    for p in range(len(points)):
        for m in range(first[p], first[p + 1]):
            T, weight = T_cw[pose[m]], robust_weights[m]
            x, y, z = transform(T, points[p, 0], points[p, 1], points[p, 2])
            w = 1 / max(z, min_depth)
            perspective_jacobian(x * w, y * w, w, J)
            for i in range(3):
                for k in range(6):
                    J[i, k] *= scale[i, m]
                for k in range(3):
                    J[i, 6 + k] = J[i, 0] * T[0, k] + J[i, 1] * T[1, k] + J[i, 2] * T[2, k]
                J[i, 9] = r[m, i]
            for k in range(3):
                j0, j1, j2 = weight * J[0, 6 + k], weight * J[1, 6 + k], weight * J[2, 6 + k]
                for i in range(4):
                    V[p, k, i] += j0 * J[0, 6 + i] + j1 * J[1, 6 + i] + j2 * J[2, 6 + i]
                for i in range(6 if row[m] >= 0 else 0):
                    W[m, k, i] = j0 * J[0, i] + j1 * J[1, i] + j2 * J[2, i]
            if row[m] < 0:
                continue
            for k in range(6):
                j0, j1, j2 = weight * J[0, k], weight * J[1, k], weight * J[2, k]
                for i in range(6):
                    U[row[m], k, i] += j0 * J[0, i] + j1 * J[1, i] + j2 * J[2, i]
                U[row[m], k, 6] += j0 * J[0, 9] + j1 * J[1, 9] + j2 * J[2, 9]


@device
def _find_rows(pose: Ints, free: Ints, count: int) -> Ints:
    """Index of each observation's pose among the free poses; -1 for fixed poses."""
    row = np.full(count, -1, np.int64)
    row[free] = np.arange(len(free))
    return row[pose]


@kernel(
    "(f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], i8[::1], i8[::1], i8[::1], i8, f8, f8, f8,"
    " UniTuple(f8, 4))"
)
def bundle_adjust(
    T_cw: Floats, points: Floats, scale: Floats, offset: Floats, thresholds: Floats, weights: Floats, pose: Ints,
    first: Ints, free: Ints, iterations: int, tolerance: float, regularisation: float, min_depth: float,
    damping_schedule: DampingSchedule,
) -> tuple[Floats, Floats, Floats, float, float, int]:  # fmt: skip
    """Optimise poses and points by Levenberg-Marquardt.

    Args:
        T_cw: Initial poses, (K, 4, 4).
        points: Initial points, world frame, (P, 3).
        scale: Scale of the whitened residuals, (3, M).
        offset: Offset of the whitened residuals, (3, M).
        thresholds: Squared residual at which Huber's loss turns linear, (M,).
        weights: Given weight of each observation, (M,).
        pose: Pose of each observation, sorted by point, (M,).
        first: First observation of each point, and M, (P + 1,).
        free: Indices of the poses that move, (F,).
        iterations: Maximum number of steps.
        tolerance: Relative change of the cost at convergence.
        regularisation: Added to the diagonal of the normal equations.
        min_depth: Smallest depth of a projected point, metres.
        damping_schedule: First, smallest and largest damping, and the factor between two steps.

    Returns:
        Poses (K, 4, 4), points (P, 3), squared residuals (M,), cost before and after, number of steps.
    """
    F, P, M, row = len(free), len(points), len(pose), _find_rows(pose, free, len(T_cw))
    U, V, W = np.empty((F, 6, 7)), np.empty((P, 3, 4)), np.empty((M, 3, 6))
    r, robust_weights, chi2 = np.empty((M, 3)), np.empty(M), np.empty(M)
    new_r, new_robust_weights, new_chi2 = np.empty((M, 3)), np.empty(M), np.empty(M)
    cost = _compute_residuals(
        T_cw, points, scale, offset, thresholds, weights, pose, first, min_depth, r, robust_weights, chi2
    )
    damping, cost_before, iteration, converged, is_linearised = damping_schedule[0], cost, 0, False, False
    while iteration < iterations and not converged:
        if not is_linearised:
            _linearise(T_cw, points, scale, pose, first, row, min_depth, r, robust_weights, U, V, W)
        xi, delta = solve_normal_equations(U, V, W, row, first, damping, regularisation)
        new_T, new_points = T_cw.copy(), points + delta
        for f in range(F):
            new_T[free[f]] = multiply(se3_exp(xi[f]), T_cw[free[f]])
        new_cost = _compute_residuals(
            new_T, new_points, scale, offset, thresholds, weights, pose, first, min_depth, new_r, new_robust_weights,
            new_chi2,
        )  # fmt: skip
        iteration += 1
        converged = has_converged(cost, new_cost, damping, tolerance)
        damping = next_damping(damping, new_cost < cost, damping_schedule)
        is_linearised = not new_cost < cost
        if not is_linearised:
            T_cw, points, cost = new_T, new_points, new_cost
            r, new_r, chi2, new_chi2 = new_r, r, new_chi2, chi2
            robust_weights, new_robust_weights = new_robust_weights, robust_weights
    return T_cw, points, chi2, cost_before, cost, iteration


@kernel(
    "(f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], i8[::1], i8[::1], i8[::1], f8[:,::1], f8, f8, f8)"
)
def reduced_cost_derivatives(
    T_cw: Floats, points: Floats, scale: Floats, offset: Floats, thresholds: Floats, weights: Floats, pose: Ints,
    first: Ints, free: Ints, j: Floats, damping: float, regularisation: float, min_depth: float,
) -> tuple[float, float]:  # fmt: skip
    """Derivatives of the minimum cost over poses and points with respect to a parameter of the measurements.

    Args:
        T_cw: Poses at the minimum, (K, 4, 4).
        points: Points at the minimum, world frame, (P, 3).
        scale: Scale of the whitened residuals, (3, M).
        offset: Offset of the whitened residuals, (3, M).
        thresholds: Squared residual at which Huber's loss turns linear, (M,).
        weights: Given weight of each observation, (M,).
        pose: Pose of each observation, sorted by point, (M,).
        first: First observation of each point, and M, (P + 1,).
        free: Indices of the poses that move, (F,).
        j: Derivative of the whitened residuals with respect to the parameter, (M, 3).
        damping: Damping of the step that follows a change of the parameter.
        regularisation: Added to the diagonal of the normal equations.
        min_depth: Smallest depth of a projected point, metres.

    Returns:
        First and second derivative.
    """
    F, P, M, row = len(free), len(points), len(pose), _find_rows(pose, free, len(T_cw))
    r, robust_weights, chi2, W = np.empty((M, 3)), np.empty(M), np.empty(M), np.empty((M, 3, 6))
    U, V, j_U, j_V = np.empty((F, 6, 7)), np.empty((P, 3, 4)), np.empty((F, 6, 7)), np.empty((P, 3, 4))
    _compute_residuals(
        T_cw, points, scale, offset, thresholds, weights, pose, first, min_depth, r, robust_weights, chi2
    )
    _linearise(T_cw, points, scale, pose, first, row, min_depth, r, robust_weights, U, V, W)
    _linearise(T_cw, points, scale, pose, first, row, min_depth, j, robust_weights, j_U, j_V, W)
    xi, delta = solve_normal_equations(j_U, j_V, W, row, first, damping, regularisation)
    slope = (xi * U[:, :, 6]).sum() + (delta * V[:, :, 3]).sum()
    curvature = (xi * j_U[:, :, 6]).sum() + (delta * j_V[:, :, 3]).sum()
    for m in range(M):
        for i in range(3):
            slope += robust_weights[m] * j[m, i] * r[m, i]
            curvature += robust_weights[m] * j[m, i] * j[m, i]
    return 2 * slope, 2 * curvature
