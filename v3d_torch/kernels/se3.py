"""Kernels for one rigid motion or one tangent vector; see `v3d_torch.geometry.se3`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels import reprojection
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.reprojection import SMALL_ANGLE

Array = NDArray[np.float64]

_MAX_NEWTON_STEPS = 8
"""Maximum number of steps: rotations with rounding errors need two; other matrices are computed by the twin."""

_NEWTON_TOLERANCE = 1e-8
"""Change of the elements in the last step. Newton's method squares the error in each step."""


@kernel("(f8[:,::1],)")
def invert(T: Array) -> Array:
    """Inverse of a rigid motion, both (4, 4)."""
    inverse = np.eye(4)
    for i in range(3):
        for j in range(3):
            inverse[i, j] = T[j, i]
        inverse[i, 3] = -(T[0, i] * T[0, 3] + T[1, i] * T[1, 3] + T[2, i] * T[2, 3])
    return inverse


@device
def _newton_step(R: Array) -> bool:
    """Replace a matrix, the first 3x3 elements, by the mean of it and its inverse transpose; check for convergence."""
    cofactors, converged = np.empty((3, 3)), True
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            cofactors[i, j] = R[a, c] * R[b, d] - R[a, d] * R[b, c]
    determinant = R[0, 0] * cofactors[0, 0] + R[0, 1] * cofactors[0, 1] + R[0, 2] * cofactors[0, 2]
    for i in range(3):
        for j in range(3):
            change = 0.5 * (cofactors[i, j] / determinant - R[i, j])
            R[i, j] += change
            converged &= abs(change) < _NEWTON_TOLERANCE
    return converged


@kernel("(f8[:,:,::1],)")
def orthonormalise(T: Array) -> tuple[bool, Array]:
    """Replace the rotations of rigid motions, (B, 4, 4), by the nearest ones: polar decomposition by Newton's method.

    N. Higham, Computing the polar decomposition with applications, SIAM J. Sci. Stat. Comput., 1986.

    Returns:
        True if the method converged for all, and the rigid motions.
    """
    result, all_converged = T.copy(), True
    for b in range(len(T)):
        result[b, 3, 0], result[b, 3, 1], result[b, 3, 2], result[b, 3, 3] = 0.0, 0.0, 0.0, 1.0
        converged = False
        for _ in range(_MAX_NEWTON_STEPS):
            converged = _newton_step(result[b])
            if converged:
                break
        all_converged &= converged
    return all_converged, result


@kernel("(f8[::1],)")
def exp(xi: Array) -> Array:
    """Exponential map of a tangent vector ``[translation, rotation]``, (6,), to a rigid motion, (4, 4)."""
    return reprojection.se3_exp(xi)


@device
def _quaternion(R: Array) -> Array:
    """Unit quaternion (w, x, y, z) of a rotation, with w >= 0."""
    rows = np.empty((4, 4))  # 4 q q^T: each row is a multiple of q, and the longest has the smallest relative error
    rows[0, 0], rows[1, 1] = R[0, 0] + R[1, 1] + R[2, 2] + 1, R[0, 0] - R[1, 1] - R[2, 2] + 1
    rows[2, 2], rows[3, 3] = R[1, 1] - R[0, 0] - R[2, 2] + 1, R[2, 2] - R[0, 0] - R[1, 1] + 1
    rows[0, 1], rows[0, 2], rows[0, 3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    rows[1, 2], rows[1, 3], rows[2, 3] = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    longest = 0
    for i in range(4):
        for j in range(i):
            rows[i, j] = rows[j, i]
        if rows[i, i] > rows[longest, longest]:
            longest = i
    q = rows[longest] / math.sqrt((rows[longest] ** 2).sum())
    return -q if q[0] < 0 else q


@kernel("(f8[:,::1],)")
def log(T: Array) -> Array:
    """Logarithm of a rigid motion, (4, 4): the tangent vector ``[translation, rotation]``, (6,)."""
    q, small = _quaternion(T), SMALL_ANGLE**2
    square = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if square < small:
        scale = 2 / max(q[0], 0.5) * (1 - square / 3)
    else:
        sine = math.sqrt(square)
        scale = 2 * math.atan2(sine, q[0]) / sine
    a, b, c = q[1] * scale, q[2] * scale, q[3] * scale
    square = a * a + b * b + c * c
    half = math.sqrt(square) / 2
    factor = 1 / 12 if square < small else (1 - half / math.tan(half)) / square
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    dx, dy, dz = b * z - c * y, c * x - a * z, a * y - b * x  # rotation vector times translation
    return np.array(
        [
            x - 0.5 * dx + factor * (b * dz - c * dy),
            y - 0.5 * dy + factor * (c * dx - a * dz),
            z - 0.5 * dz + factor * (a * dy - b * dx),
            a,
            b,
            c,
        ]
    )
