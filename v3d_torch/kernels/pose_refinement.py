"""Kernel of the pose refinement; see `v3d_torch.optim.pose_refinement`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.levenberg_marquardt import DampingSchedule, has_converged, next_damping
from v3d_torch.kernels.reprojection import huber, multiply, perspective_jacobian, se3_exp, solve_symmetric, transform


@device
def _linearise(
    T_cw: Floats, points: Floats, scale: Floats, offset: Floats, thresholds: Floats, weights: Floats, active: Bools,
    min_depth: float, H: Floats, g: Floats, chi2: Floats,
) -> float:  # fmt: skip
    """Return the robust cost of the active measurements; write the normal equations and all squared errors."""
    H[:], g[:] = 0.0, 0.0
    J, cost = np.empty((3, 6)), 0.0
    for i in range(len(points)):
        x, y, z = transform(T_cw, points[i, 0], points[i, 1], points[i, 2])
        w = 1 / max(z, min_depth)
        a, b = x * w, y * w
        r0, r1, r2 = scale[0, i] * a + offset[0, i], scale[1, i] * b + offset[1, i], scale[2, i] * w + offset[2, i]
        squared = r0 * r0 + r1 * r1 + r2 * r2
        chi2[i] = squared if z > min_depth else np.inf
        if not active[i]:
            continue
        robust, weight = huber(squared, thresholds[i])
        cost += weights[i] * robust
        weight *= weights[i]
        perspective_jacobian(a, b, w, J)
        for k in range(6):
            j0, j1, j2 = scale[0, i] * J[0, k], scale[1, i] * J[1, k], scale[2, i] * J[2, k]
            g[k] += weight * (j0 * r0 + j1 * r1 + j2 * r2)
            j0, j1, j2 = weight * scale[0, i] * j0, weight * scale[1, i] * j1, weight * scale[2, i] * j2
            for m in range(k + 1):
                H[k, m] += j0 * J[0, m] + j1 * J[1, m] + j2 * J[2, m]
    for k in range(6):
        for m in range(k):
            H[m, k] = H[k, m]
    return cost


@device
def _refine(
    T_cw: Floats, points: Floats, scale: Floats, offset: Floats, thresholds: Floats, weights: Floats, valid: Bools,
    rounds: int, iterations: int, tolerance: float, regularisation: float, min_depth: float,
    damping_schedule: DampingSchedule, inliers: Bools, active: Bools,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Refine one pose; write the masks, and return pose, squared residuals and information matrix."""
    count = len(points)
    inliers[:], active[:], loss_thresholds = valid, valid, thresholds.copy()
    H, g, chi2 = np.empty((6, 6)), np.empty(6), np.empty(count)
    new_H, new_g, new_chi2 = np.empty((6, 6)), np.empty(6), np.empty(count)
    for index in range(rounds):
        robust = 2 * index < rounds
        if not robust:
            loss_thresholds[:] = np.inf
        active[:] = inliers
        cost = _linearise(T_cw, points, scale, offset, loss_thresholds, weights, active, min_depth, H, g, chi2)
        damping, converged, iteration = damping_schedule[0], False, 0
        while iteration < iterations and not converged:
            damped = H.copy()
            for k in range(6):
                damped[k, k] = damped[k, k] * (1 + damping) + regularisation
            candidate = multiply(se3_exp(-solve_symmetric(damped, g)), T_cw)
            new_cost = _linearise(
                candidate, points, scale, offset, loss_thresholds, weights, active, min_depth, new_H, new_g, new_chi2
            )
            iteration += 1
            converged = has_converged(cost, new_cost, damping, tolerance)
            damping = next_damping(damping, new_cost < cost, damping_schedule)
            if new_cost < cost:
                T_cw, cost = candidate, new_cost
                H, new_H, g, new_g, chi2, new_chi2 = new_H, H, new_g, g, new_chi2, chi2
        unchanged = True
        for i in range(count):
            is_inlier = valid[i] and chi2[i] <= thresholds[i]
            unchanged &= is_inlier == inliers[i]
            inliers[i] = is_inlier
        if not robust and unchanged:
            break
    for i in range(count):
        if not valid[i]:
            chi2[i] = np.inf
    return T_cw, chi2, H


@kernel(
    "(f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[:,::1], b1[:,::1], i8, i8, f8, f8, f8,"
    " UniTuple(f8, 4))"
)
def refine_poses(
    T_cw: Floats, points: Floats, scale: Floats, offset: Floats, thresholds: Floats, weights: Floats, valid: Bools,
    rounds: int, iterations: int, tolerance: float, regularisation: float, min_depth: float,
    damping_schedule: DampingSchedule,
) -> tuple[Floats, Bools, Bools, Floats, Floats]:  # fmt: skip
    """Refine B poses in rounds of Levenberg-Marquardt, each with N measurements.

    Args:
        T_cw: Initial poses, (B, 4, 4).
        points: Landmarks, world frame, (B, N, 3).
        scale: Scale of the whitened residuals, (B, 3, N).
        offset: Offset of the whitened residuals, (B, 3, N).
        thresholds: Squared residual at which Huber's loss turns linear, and up to which a measurement is an inlier,
            (B, N).
        weights: Weight of each measurement, (B, N).
        valid: Measurements that are not padding, (B, N).
        rounds: Maximum number of rounds; the first half of them is robust.
        iterations: Maximum number of steps in a round.
        tolerance: Relative change of the cost at convergence.
        regularisation: Added to the diagonal of the normal equations.
        min_depth: Smallest depth of a projected point, metres.
        damping_schedule: First, smallest and largest damping, and the factor between two steps.

    Returns:
        Poses (B, 4, 4), inliers (B, N), mask of the measurements used in the last round (B, N), squared residuals
        (B, N), information matrices (B, 6, 6).
    """
    refined, inliers, active = np.empty(T_cw.shape), np.empty(valid.shape, np.bool_), np.empty(valid.shape, np.bool_)
    chi2, information = np.empty(valid.shape), np.empty((len(T_cw), 6, 6))
    for b in range(len(T_cw)):
        refined[b], chi2[b], information[b] = _refine(
            T_cw[b], points[b], scale[b], offset[b], thresholds[b], weights[b], valid[b], rounds, iterations,
            tolerance, regularisation, min_depth, damping_schedule, inliers[b], active[b],
        )  # fmt: skip
    return refined, inliers, active, chi2, information
