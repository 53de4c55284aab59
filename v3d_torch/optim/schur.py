r"""Normal equations of a bundle adjustment, solved by the Schur complement.

With the free poses first and the points second, :math:`H = J^T W J` has the block structure

.. math::
    \begin{pmatrix} U & W^T \\ W & V \end{pmatrix}
    \begin{pmatrix} \xi \\ \delta \end{pmatrix} = - \begin{pmatrix} g_{pose} \\ g_{point} \end{pmatrix}

for one or several right-hand sides, with block-diagonal :math:`U` (6x6 blocks) and :math:`V` (3x3 blocks). The points
are eliminated; the reduced camera system, 6 unknowns per pose, is solved densely (Triggs et al., Bundle Adjustment - A
Modern Synthesis, 2000).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

REGULARISATION = 1e-6
"""Added to all diagonals: makes blocks without observations solvable. Small beside the information of an observation,
which is 1e4 per square metre and more."""


@dataclass(frozen=True)
class NormalEquations:
    r"""Blocks of the normal equations of F free poses, P points, N observations by free poses and C right-hand sides.

    Attributes:
        U: Diagonal blocks of the poses, followed by the columns :math:`g_{pose}`, shape :math:`(F, 6, 6 + C)`.
        V: Diagonal blocks of the points, followed by the columns :math:`g_{point}`, shape :math:`(3, 3 + C, P)`.
        W: Point-by-pose block of each observation, shape :math:`(3, 6, N)`.
        pose: Index of the free pose of each observation, int64, shape :math:`(N,)`.
        point: Index of the point of each observation, int64, shape :math:`(N,)`.
    """

    U: Tensor
    V: Tensor
    W: Tensor
    pose: Tensor
    point: Tensor


def gather_columns(rows: Tensor, index: Tensor) -> Tensor:
    """Gather columns of a matrix; faster than indexing.

    Args:
        rows: Matrix, shape :math:`(n, K)`.
        index: Indices of the columns, int64, shape :math:`(M,)`.

    Returns:
        Shape :math:`(n, M)`.
    """
    return rows.gather(1, index.expand(len(rows), -1))


def solve_normal_equations(system: NormalEquations, damping: float) -> tuple[Tensor, Tensor]:
    r"""Solve damped normal equations by the Schur complement.

    With :math:`V = L L^T` and :math:`Y = L^{-1} W`, elimination of the points gives the reduced camera system
    :math:`(U - Y^T Y)\, \xi = -g_{pose} + Y^T L^{-1} g_{point}`.

    Args:
        system: Normal equations of F poses, P points and C right-hand sides.
        damping: Factor :math:`\lambda`; :math:`\lambda` times the diagonal is added. The damping keeps unobservable
            directions in place, such as the depth of a point that was observed once without depth.

    Returns:
        Steps of the poses, shape :math:`(F, 6, C)`, and of the points, shape :math:`(P, 3, C)`.
    """
    F, P, C = system.U.shape[0], system.V.shape[-1], system.V.shape[1] - 3
    U, V = _damp(system.U[..., :6].permute(1, 2, 0), damping), _damp(system.V[:, :3], damping)
    L = _cholesky(V)
    h = _forward(L, system.V[:, 3:])  # (3, C, P)
    blocks = _forward(gather_columns(L.flatten(0, 1), system.point).unflatten(0, (3, 3)), system.W)
    # Y is dense: a local map is small, and most of its poses observe many of its points. It is stored transposed, poses
    # by points, with the points ordered by coordinate first, like h.
    index = (
        (18 * P * system.pose + system.point) + P * torch.arange(3)[:, None, None] + 3 * P * torch.arange(6)[:, None]
    )
    Yt = blocks.new_zeros(18 * F * P).scatter_add_(0, index.flatten(), blocks.flatten()).view(6 * F, 3 * P)
    S = -(Yt @ Yt.T)
    S.view(F, 6, F, 6).diagonal(dim1=0, dim2=2).add_(U)
    xi = torch.linalg.solve(S, Yt @ h.transpose(1, 2).reshape(3 * P, C) - system.U[..., 6:].flatten(0, 1))
    delta = _backward(L, -(h + (Yt.T @ xi).view(3, P, C).transpose(1, 2)))
    return xi.view(F, 6, C), delta.permute(2, 0, 1)


def _damp(blocks: Tensor, damping: float) -> Tensor:
    """Blocks (n, n, count) with damped diagonals."""
    blocks = blocks.clone()
    diagonal = blocks.diagonal(dim1=0, dim2=1)
    diagonal.mul_(1 + damping).add_(REGULARISATION)
    return blocks


def _cholesky(V: Tensor) -> Tensor:
    """Cholesky factors L of positive definite 3x3 blocks, both (3, 3, P); faster than LAPACK for small blocks."""
    L = torch.zeros_like(V)
    for row in range(3):
        for column in range(row + 1):
            rest = V[row, column] - (L[row, :column] * L[column, :column]).sum(dim=0)
            L[row, column] = rest.sqrt() if row == column else rest / L[column, column]
    return L


def _forward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L x = b for each block, with L of shape (3, 3, N) and b of shape (3, ..., N)."""
    x = torch.empty_like(b)
    for row in range(3):
        x[row] = b[row]
        for column in range(row):
            x[row].addcmul_(L[row, column], x[column], value=-1)
        x[row] /= L[row, row]
    return x


def _backward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L^T x = b for each block, with shapes as in `_forward`."""
    return _forward(L.transpose(0, 1).flip(0, 1), b.flip(0)).flip(0)
