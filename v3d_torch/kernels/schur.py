"""Schur complement: part of the kernel of bundle adjustment; see `v3d_torch.optim.schur`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Floats, Ints
from v3d_torch.kernels.compiler import device
from v3d_torch.kernels.reprojection import solve_symmetric


@device
def solve_normal_equations(
    U: Floats, V: Floats, W: Floats, row: Ints, first: Ints, damping: float, regularisation: float
) -> tuple[Floats, Floats]:
    """Solve damped normal equations of F poses, P points and M observations by the Schur complement.

    Args:
        U: Diagonal blocks of the poses, with the gradient as last column, (F, 6, 7).
        V: Diagonal blocks of the points, with the gradient as last column, (P, 3, 4).
        W: Point-by-pose block of each observation by a free pose, sorted by point, (M, 3, 6).
        row: Index of the pose of each observation among the F poses; -1 for fixed poses, (M,).
        first: First observation of each point, and M, (P + 1,).
        damping: Factor of the diagonal that is added to the diagonal.
        regularisation: Number that is added to the diagonal.

    Returns:
        Steps of the poses (F, 6) and of the points (P, 3).
    """
    F, P = len(U), len(V)
    S, b, h, L, Y = np.zeros((6 * F, 6 * F)), np.empty(6 * F), np.empty((P, 3)), np.empty((P, 3, 3)), np.empty(W.shape)
    for f in range(F):
        for i in range(6):
            S[6 * f + i, 6 * f : 6 * f + 6] = U[f, i, :6]
            S[6 * f + i, 6 * f + i] = U[f, i, i] * (1 + damping) + regularisation
            b[6 * f + i] = -U[f, i, 6]
    for p in range(P):
        _cholesky(V[p], damping, regularisation, L[p])
        _forward(L[p], V[p, :, 3:], h[p].reshape(3, 1))
    for p in range(P):
        for m in range(first[p], first[p + 1]):
            a = row[m]
            if a < 0:
                continue
            _forward(L[p], W[m], Y[m])
            for k in range(6):
                b[6 * a + k] += Y[m, 0, k] * h[p, 0] + Y[m, 1, k] * h[p, 1] + Y[m, 2, k] * h[p, 2]
        for m in range(first[p], first[p + 1]):
            for n in range(first[p], first[p + 1]):
                if 0 <= row[n] <= row[m]:  # the solver reads the lower triangle
                    _subtract_product(Y[m], Y[n], S, 6 * row[m], 6 * row[n])
    xi = solve_symmetric(S, b).reshape(F, 6)
    delta = np.empty((P, 3))
    for p in range(P):
        for m in range(first[p], first[p + 1]):
            if row[m] >= 0:
                for k in range(6):
                    for i in range(3):
                        h[p, i] += Y[m, i, k] * xi[row[m], k]
        delta[p, 2] = -h[p, 2] * L[p, 2, 2]
        delta[p, 1] = (-h[p, 1] - L[p, 2, 1] * delta[p, 2]) * L[p, 1, 1]
        delta[p, 0] = (-h[p, 0] - L[p, 1, 0] * delta[p, 1] - L[p, 2, 0] * delta[p, 2]) * L[p, 0, 0]
    return xi, delta


@device
def _subtract_product(A: Floats, B: Floats, S: Floats, row: int, column: int) -> None:
    """Subtract ``A^T B``, with (3, 6) matrices A and B, from the block of S that begins at a row and a column."""
    for i in range(6):
        a0, a1, a2 = A[0, i], A[1, i], A[2, i]
        for k in range(6):
            S[row + i, column + k] -= a0 * B[0, k] + a1 * B[1, k] + a2 * B[2, k]


@device
def _cholesky(V: Floats, damping: float, regularisation: float, L: Floats) -> None:
    """Write the Cholesky factor of a damped (3, 3) block, the first columns of V, to L, with an inverted diagonal."""
    for i in range(3):
        for k in range(i + 1):
            rest = V[i, k] if i != k else V[i, i] * (1 + damping) + regularisation
            for j in range(k):
                rest -= L[i, j] * L[k, j]
            L[i, k] = 1 / math.sqrt(rest) if i == k else rest * L[k, k]


@device
def _forward(L: Floats, B: Floats, X: Floats) -> None:
    """Solve ``L X = B`` with a factor of `_cholesky` and (3, n) matrices B and X."""
    for k in range(B.shape[1]):
        x = B[0, k] * L[0, 0]
        y = (B[1, k] - L[1, 0] * x) * L[1, 1]
        X[0, k], X[1, k], X[2, k] = x, y, (B[2, k] - L[2, 0] * x - L[2, 1] * y) * L[2, 2]
