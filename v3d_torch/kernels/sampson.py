"""Kernel of the refinement of essential matrices; see `v3d_torch.features.sampson`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.levenberg_marquardt import DampingSchedule, has_converged, next_damping
from v3d_torch.kernels.reprojection import multiply, se3_exp, solve_symmetric

_MIN_SQUARE = 1e-30
"""Smallest squared denominator of a Sampson distance."""


@device
def _fundamental(U: Floats, V: Floats, K_inverse: Floats) -> Floats:
    """Fundamental matrix of the rotations U and V."""
    E = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            E[i, k] = math.sqrt(0.5) * (U[i, 0] * V[k, 0] + U[i, 1] * V[k, 1])
    return multiply(multiply(K_inverse.T, E), K_inverse)


@device
def _tangents(U: Floats, V: Floats, K_inverse: Floats) -> Floats:
    """Derivatives of the fundamental matrix with respect to the five parameters of an update, (5, 3, 3)."""
    G, axes = np.empty((5, 3, 3)), np.zeros((5, 3))
    for i in range(3):
        axes[i, i], axes[3, i], axes[4, i] = 1.0, V[i, 0], V[i, 1]
    for k in range(5):
        axis = axes[k]
        turned = U.copy() if k < 3 else V.copy()
        for j in range(2):
            x, y, z = turned[0, j], turned[1, j], turned[2, j]
            turned[0, j] = axis[1] * z - axis[2] * y
            turned[1, j] = axis[2] * x - axis[0] * z
            turned[2, j] = axis[0] * y - axis[1] * x
        G[k] = _fundamental(turned, V, K_inverse) if k < 3 else _fundamental(U, turned, K_inverse)
    return G


@device
def _constraint(F: Floats, a: Floats, b: Floats) -> tuple[float, float, float, float, float]:
    """Product ``b^T F a``, and the first two elements of the epipolar lines in image b and in image a."""
    b0, b1, b2 = (F[0, 0] * a[0] + F[0, 1] * a[1] + F[0, 2] * a[2], F[1, 0] * a[0] + F[1, 1] * a[1] + F[1, 2] * a[2],
                  F[2, 0] * a[0] + F[2, 1] * a[1] + F[2, 2] * a[2])  # fmt: skip
    a0, a1 = F[0, 0] * b[0] + F[1, 0] * b[1] + F[2, 0] * b[2], F[0, 1] * b[0] + F[1, 1] * b[1] + F[2, 1] * b[2]
    return b0 * b[0] + b1 * b[1] + b2 * b[2], b0, b1, a0, a1


@device
def _length(a0: float, a1: float, b0: float, b1: float) -> float:
    """Denominator of the Sampson distance, from the first two elements of both epipolar lines."""
    return math.sqrt(max(a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1, _MIN_SQUARE))


@device
def _linearise(
    U: Floats, V: Floats, K_inverse: Floats, a: Floats, b: Floats, weights: Floats, active: Bools, H: Floats, g: Floats
) -> float:
    """Return the cost of the active pairs; write the normal equations."""
    F, G, J, cost = _fundamental(U, V, K_inverse), _tangents(U, V, K_inverse), np.empty(5), 0.0
    H[:], g[:] = 0.0, 0.0
    for i in range(len(a)):
        if not active[i]:
            continue
        product, b0, b1, a0, a1 = _constraint(F, a[i], b[i])
        length = _length(a0, a1, b0, b1)
        r = product / length
        cost += weights[i] * r * r
        for k in range(5):
            change, db0, db1, da0, da1 = _constraint(G[k], a[i], b[i])
            J[k] = (change - r * (a0 * da0 + a1 * da1 + b0 * db0 + b1 * db1) / length) / length
        for k in range(5):
            g[k] += weights[i] * J[k] * r
            for m in range(5):
                H[k, m] += weights[i] * J[k] * J[m]
    return cost


@device
def _classify(
    U: Floats, V: Floats, K_inverse: Floats, a: Floats, b: Floats, valid: Bools, threshold: float, inliers: Bools
) -> bool:
    """Write the mask of valid pairs within the threshold; return True if it did not change."""
    F, unchanged = _fundamental(U, V, K_inverse), True
    for i in range(len(a)):
        product, b0, b1, a0, a1 = _constraint(F, a[i], b[i])
        length = _length(a0, a1, b0, b1)
        is_inlier = valid[i] and abs(product) <= threshold * length
        unchanged &= is_inlier == inliers[i]
        inliers[i] = is_inlier
    return unchanged


@device
def _move(U: Floats, V: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Rotate U about three axes, and V about its first two columns."""
    turn_U, turn_V = np.zeros(6), np.zeros(6)
    for i in range(3):
        turn_U[3 + i], turn_V[3 + i] = x[i], V[i, 0] * x[3] + V[i, 1] * x[4]
    return multiply(se3_exp(turn_U)[:3, :3], U), multiply(se3_exp(turn_V)[:3, :3], V)


@kernel(
    "(f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], b1[:,::1], f8, i8, i8, f8, f8,"
    " UniTuple(f8, 4))"
)
def refine_essential(
    U: Floats, V: Floats, K_inverse: Floats, a: Floats, b: Floats, weights: Floats, valid: Bools, threshold: float,
    rounds: int, iterations: int, tolerance: float, regularisation: float, damping_schedule: DampingSchedule,
) -> tuple[Floats, Floats, Bools, Bools]:  # fmt: skip
    """Refine B essential matrices in rounds of Levenberg-Marquardt, each with N pairs of pixels.

    Args:
        U: Initial rotations, (B, 3, 3).
        V: Initial rotations, (B, 3, 3).
        K_inverse: Inverse camera matrices, (B, 3, 3).
        a: Homogeneous pixels in image a, (B, N, 3).
        b: Homogeneous pixels in image b, (B, N, 3).
        weights: Weight of each pair, (B, N).
        valid: Pairs that are not padding, (B, N).
        threshold: Maximum Sampson distance of an inlier, pixels.
        rounds: Maximum number of rounds; all pairs are classified after each.
        iterations: Maximum number of steps in a round.
        tolerance: Relative change of the cost at convergence.
        regularisation: Added to the diagonal of the normal equations.
        damping_schedule: First, smallest and largest damping, and the factor between two steps.

    Returns:
        Rotations U and V (B, 3, 3), inliers (B, N), mask of the pairs used in the last round (B, N).
    """
    U, V, inliers, active = U.copy(), V.copy(), np.zeros(valid.shape, np.bool_), np.zeros(valid.shape, np.bool_)
    H, g, new_H, new_g = np.empty((5, 5)), np.empty(5), np.empty((5, 5)), np.empty(5)
    for p in range(len(U)):
        _classify(U[p], V[p], K_inverse[p], a[p], b[p], valid[p], threshold, inliers[p])
        for _ in range(rounds):
            active[p] = inliers[p]
            cost = _linearise(U[p], V[p], K_inverse[p], a[p], b[p], weights[p], active[p], H, g)
            damping, converged, iteration = damping_schedule[0], False, 0
            while iteration < iterations and not converged:
                damped = H.copy()
                for k in range(5):
                    damped[k, k] = damped[k, k] * (1 + damping) + regularisation
                new_U, new_V = _move(U[p], V[p], -solve_symmetric(damped, g))
                new_cost = _linearise(new_U, new_V, K_inverse[p], a[p], b[p], weights[p], active[p], new_H, new_g)
                iteration += 1
                converged = has_converged(cost, new_cost, damping, tolerance)
                damping = next_damping(damping, new_cost < cost, damping_schedule)
                if new_cost < cost:
                    U[p], V[p], cost = new_U, new_V, new_cost
                    H, new_H, g, new_g = new_H, H, new_g, g
            if _classify(U[p], V[p], K_inverse[p], a[p], b[p], valid[p], threshold, inliers[p]):
                break
    return U, V, inliers, active
