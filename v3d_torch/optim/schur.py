"""The normal equations of a bundle adjustment, solved by the Schur complement.

Landmarks, three unknowns each, are eliminated; what is left, 6 unknowns per pose, is solved densely (Triggs et al.,
"Bundle Adjustment - A Modern Synthesis", 2000).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class NormalEquations:
    r"""Blocks of :math:`J^T W J` and, behind the last column of the square ones, of :math:`J^T W r`.

    Attributes:
        U: pose by pose, for F free poses, shape :math:`(F, 6, 7)`.
        V: point by point, shape :math:`(3, 4, P)`.
        W: point by pose, for each of the N observations by free poses, shape :math:`(3, 6, N)`.
        pose: which of the free poses that is, int64, shape :math:`(N,)`.
        point: which point, int64, shape :math:`(N,)`.
    """

    U: Tensor
    V: Tensor
    W: Tensor
    pose: Tensor
    point: Tensor


def columns(rows: Tensor, index: Tensor) -> Tensor:
    """Columns of (n, K) chosen by (M,), shape (n, M); to gather by an index for each takes a quarter of indexing."""
    return rows.gather(1, index.expand(len(rows), -1))


def solve_normal_equations(system: NormalEquations, damping: float) -> tuple[Tensor, Tensor]:
    r"""Minimise the quadratic model with :math:`\lambda` times its diagonal added, by the Schur complement.

    With :math:`V = L L^T` and :math:`Y = L^{-1} W`, the points are gone from
    :math:`(U - Y^T Y)\, \xi = -g_{pose} + Y^T L^{-1} g_{point}`.

    Args:
        system: of F poses and P points.
        damping: :math:`\lambda`; keeps directions that nothing observes (a point seen once, without depth) in place.

    Returns:
        Steps of the poses, shape :math:`(F, 6)`, and of the points, shape :math:`(P, 3)`.
    """
    F, P = system.U.shape[0], system.V.shape[-1]
    U, V = _damp(system.U[..., :6].permute(1, 2, 0), damping), _damp(system.V[:, :3], damping)
    L = _cholesky(V)
    h = _forward(L, system.V[:, 3])
    blocks = _forward(columns(L.flatten(0, 1), system.point).unflatten(0, (3, 3)), system.W)
    # Y is dense, as a local map is small and most poses see much of it; transposed, so that its blocks lie apart.
    place = (
        (18 * P * system.pose + system.point) + P * torch.arange(3)[:, None, None] + 3 * P * torch.arange(6)[:, None]
    )
    Yt = blocks.new_zeros(18 * F * P).scatter_add_(0, place.flatten(), blocks.flatten()).view(6 * F, 3 * P)
    S = -(Yt @ Yt.T)
    S.view(F, 6, F, 6).diagonal(dim1=0, dim2=2).add_(U)
    xi = torch.linalg.solve(S, Yt @ h.flatten() - system.U[..., 6].flatten())
    moved = _backward(L, -(h + (Yt.T @ xi).view(3, P)))
    return xi.view(F, 6), moved.T


def _damp(blocks: Tensor, damping: float) -> Tensor:
    """Blocks (n, n, count) with more on their diagonals."""
    # Next to information of 1e4 per square metre and more, 1e-6 is nothing; a block that nothing observes needs it.
    blocks = blocks.clone()
    diagonal = blocks.diagonal(dim1=0, dim2=1)
    diagonal.mul_(1 + damping).add_(1e-6)
    return blocks


def _cholesky(V: Tensor) -> Tensor:
    """Lower triangles of positive definite 3x3 blocks, both :math:`(3, 3, P)`: LAPACK takes longer for small ones."""
    L = torch.zeros_like(V)
    for row in range(3):
        for column in range(row + 1):
            rest = V[row, column] - (L[row, :column] * L[column, :column]).sum(dim=0)
            L[row, column] = rest.sqrt() if row == column else rest / L[column, column]
    return L


def _forward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L x = b, block by block, for :math:`(3, 3, N)` and :math:`(3, ..., N)`."""
    x = torch.empty_like(b)
    for row in range(3):
        x[row] = b[row]
        for column in range(row):
            x[row].addcmul_(L[row, column], x[column], value=-1)
        x[row] /= L[row, row]
    return x


def _backward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L^T x = b."""
    return _forward(L.transpose(0, 1).flip(0, 1), b.flip(0)).flip(0)
