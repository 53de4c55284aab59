"""Reprojection of one landmark and update of one pose: parts of the kernels of pose refinement and bundle adjustment.

The formulas are those of `v3d_torch.optim.reprojection` and `v3d_torch.geometry.se3`.
"""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Floats
from v3d_torch.kernels.compiler import device

SMALL_ANGLE = 1e-4
"""Rotation angle in radians below which the limits of the closed forms are exact to float64."""


@device
def transform(T: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Apply a rigid motion, shape (4, 4), to a point."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@device
def huber(squared: float, threshold: float) -> tuple[float, float]:
    """Cost and weight of a squared error; the threshold is the squared error at which the loss turns linear."""
    weight = min(math.sqrt(threshold / max(squared, 1e-300)), 1.0)
    return squared * weight * (2 - weight), weight


@device
def perspective_jacobian(a: float, b: float, w: float, J: Floats) -> None:
    """Write to ``J``, (3, 6): derivatives of (x/z, y/z, 1/z) with respect to the left perturbation of the pose."""
    J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 4], J[0, 5] = w, 0.0, -w * a, -b * a, a * a + 1, -b
    J[1, 0], J[1, 1], J[1, 2], J[1, 3], J[1, 4], J[1, 5] = 0.0, w, -w * b, -b * b - 1, a * b, a
    J[2, 0], J[2, 1], J[2, 2], J[2, 3], J[2, 4], J[2, 5] = 0.0, 0.0, -w * w, -b * w, a * w, 0.0


@device
def se3_exp(xi: Floats) -> Floats:
    """Rigid motion, shape (4, 4), of a tangent vector ``[translation, rotation]``."""
    X = np.zeros((4, 4))
    X[0, 3], X[1, 3], X[2, 3] = xi[0], xi[1], xi[2]
    X[2, 1], X[0, 2], X[1, 0] = xi[3], xi[4], xi[5]
    X[1, 2], X[2, 0], X[0, 1] = -xi[3], -xi[4], -xi[5]
    angle = max(math.sqrt(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2), SMALL_ANGLE)
    b = 2 * (math.sin(angle / 2) / angle) ** 2
    c = (angle - math.sin(angle)) / angle**3
    X2 = multiply(X, X)
    return np.eye(4) + X + b * X2 + c * multiply(X2, X)


@device
def multiply(A: Floats, B: Floats) -> Floats:
    """Product of two matrices; for small matrices a loop is faster than BLAS."""
    C = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                C[i, j] += A[i, k] * B[k, j]
    return C


@device
def solve_symmetric(A: Floats, b: Floats) -> Floats:
    """Solve ``A x = b`` for a symmetric positive definite matrix, by the decomposition ``L D L^T``."""
    n = len(b)
    L, x = np.zeros((n, n)), b.copy()
    for j in range(n):
        for i in range(j, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k] * L[k, k]
            L[i, j] = total if i == j else total / L[j, j]  # the diagonal of L stores D
        for k in range(j):
            x[j] -= L[j, k] * x[k]
    for j in range(n - 1, -1, -1):
        x[j] /= L[j, j]
        for k in range(j + 1, n):
            x[j] -= L[k, j] * x[k]
    return x
