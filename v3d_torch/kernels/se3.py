"""Kernels for rigid motions and tangent vectors; see `v3d_torch.geometry.se3`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels import reprojection
from v3d_torch.kernels.arrays import Floats
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.reprojection import SMALL_ANGLE

_MAX_NEWTON_STEPS = 8
"""Maximum number of steps: rotations with rounding errors need two; other matrices are computed by the twin."""

_NEWTON_TOLERANCE = 1e-8
"""Change of the elements in the last step. Newton's method squares the error in each step."""

SERIES_ANGLE_SQUARED = 1e-4
"""Squared rotation angle below which the Jacobian is computed from its power series, to avoid cancellation."""


@kernel("(f8[:,::1],)")
def invert(T: Floats) -> Floats:
    """Inverse of a rigid motion, both (4, 4)."""
    inverse = np.eye(4)
    for i in range(3):
        for j in range(3):
            inverse[i, j] = T[j, i]
        inverse[i, 3] = 0.0 - (T[0, i] * T[0, 3] + T[1, i] * T[1, 3] + T[2, i] * T[2, 3])
    return inverse


@device
def _newton_step(R: Floats) -> bool:
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
def orthonormalise(T: Floats) -> tuple[bool, Floats]:
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
def exp(xi: Floats) -> Floats:
    """Exponential map of a tangent vector ``[translation, rotation]``, (6,), to a rigid motion, (4, 4)."""
    return reprojection.se3_exp(xi)


@device
def _quaternion(R: Floats) -> Floats:
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


@device
def log(T: Floats) -> Floats:
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


@kernel("(f8[:,:,::1],)")
def logarithms(T: Floats) -> Floats:
    """Logarithms of rigid motions, (B, 4, 4): the tangent vectors, (B, 6)."""
    result = np.empty((len(T), 6))
    for b in range(len(T)):
        result[b] = log(T[b])
    return result


@device
def _write_skew(x: float, y: float, z: float, matrix: Floats, row: int, column: int) -> None:
    """Write the matrix of the cross product with a vector to a block of a matrix of zeros."""
    matrix[row, column + 1], matrix[row, column + 2], matrix[row + 1, column + 2] = -z, y, -x
    matrix[row + 1, column], matrix[row + 2, column], matrix[row + 2, column + 1] = z, -y, x


@device
def right_jacobian_inverse(xi: Floats) -> Floats:
    """Derivative of a logarithm with respect to a right perturbation, (6, 6): `left_jacobian_inverse` of ``-xi``."""
    A, J = np.zeros((6, 6)), np.eye(6)
    _write_skew(xi[3], xi[4], xi[5], A, 0, 0)
    _write_skew(xi[3], xi[4], xi[5], A, 3, 3)
    _write_skew(xi[0], xi[1], xi[2], A, 0, 3)
    square = xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5]
    if square < SERIES_ANGLE_SQUARED:
        b, a = -1 / 720 - square / 15120, 1 / 12 - square * square / 30240
    else:
        angle = math.sqrt(square)
        cotangent = 1 / math.tan(angle / 2)
        slope = cotangent / 2 - angle / (4 * math.sin(angle / 2) ** 2)
        b = (1 + angle * slope / 2 - angle / 2 * cotangent) / (square * square)
        a = 2 * b * square - slope / (2 * angle)
    A2 = reprojection.multiply(A, A)
    A4 = reprojection.multiply(A2, A2)
    for i in range(6):
        for k in range(6):
            J[i, k] += 0.5 * A[i, k] + a * A2[i, k] + b * A4[i, k]
    return J


@kernel("(f8[:,::1],)")
def adjoint(T: Floats) -> Floats:
    """Adjoint of a rigid motion, (6, 6)."""
    A, skew = np.zeros((6, 6)), np.zeros((3, 3))
    _write_skew(T[0, 3], T[1, 3], T[2, 3], skew, 0, 0)
    B = reprojection.multiply(skew, T[:3, :3])
    for i in range(3):
        for k in range(3):
            A[i, k], A[3 + i, 3 + k], A[i, 3 + k] = T[i, k], T[i, k], B[i, k]
    return A
