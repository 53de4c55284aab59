r"""Normal equations of a bundle adjustment, solved by the Schur complement.

With the free poses first and the points second, :math:`H = J^T W J` has the block structure

.. math::
    \begin{pmatrix} U & W^T \\ W & V \end{pmatrix}
    \begin{pmatrix} \xi \\ \delta \end{pmatrix} = - \begin{pmatrix} g_{pose} \\ g_{point} \end{pmatrix}

with block-diagonal :math:`U` (6x6 blocks) and :math:`V` (3x3 blocks). The points are eliminated; the reduced camera
system, 6 unknowns per pose, is solved densely (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

SCHUR_REGULARISATION = 1e-6
"""Number added to all diagonals, which makes blocks without observations solvable. It is small compared with the
information of an observation across its ray: 3e2 per square metre for a feature of the coarsest pyramid level at 8 m,
at a focal length of 525 pixels."""


class NormalEquations(NamedTuple):
    r"""Blocks of the normal equations of F free poses, P points and M observations.

    Attributes:
        U: Diagonal blocks of the poses, shape :math:`(..., 6, 6, F)`.
        V: Diagonal blocks of the points, shape :math:`(..., 3, 3, P)`.
        W: Point-by-pose block of each observation, shape :math:`(..., 3, 6, M)`.
        pose_gradient: Gradient :math:`g_{pose}`, shape :math:`(*, ..., 6, F)`; a matrix can have several gradients.
        point_gradient: Gradient :math:`g_{point}`, shape :math:`(*, ..., 3, P)`.
        pose: Index of the free pose of each observation, F for fixed poses, int64, shape :math:`(..., M)`.
        point: Index of the point of each observation, int64, shape :math:`(..., M)`.
    """

    U: Tensor
    V: Tensor
    W: Tensor
    pose_gradient: Tensor
    point_gradient: Tensor
    pose: Tensor
    point: Tensor


def gather_columns(rows: Tensor, index: Tensor) -> Tensor:
    """Gather columns of matrices; faster than indexing.

    Args:
        rows: Matrices, shape :math:`(..., n, K)`.
        index: Indices of the columns, int64, shape :math:`(..., M)`.

    Returns:
        Shape :math:`(..., n, M)`.
    """
    return rows.gather(-1, index[..., None, :].expand(*rows.shape[:-1], index.shape[-1]))


def sum_columns(columns: Tensor, index: Tensor, count: int) -> Tensor:
    """Sum the columns of matrices that have the same index, the inverse of `gather_columns`.

    Args:
        columns: Matrices, shape :math:`(..., n, M)`.
        index: Index of the sum to which each column is added, int64, shape :math:`(..., M)`; columns with the index
            ``count`` are ignored.
        count: Number of sums K.

    Returns:
        Shape :math:`(..., n, K)`.
    """
    sums = columns.new_zeros(*columns.shape[:-1], count + 1)
    return sums.scatter_add(-1, index[..., None, :].expand_as(columns), columns)[..., :count]


def solve_normal_equations(system: NormalEquations, damping: Tensor | float) -> tuple[Tensor, Tensor]:
    r"""Solve damped normal equations by the Schur complement.

    With :math:`V = L D L^T` and :math:`Y = L^{-1} W`, elimination of the points gives the reduced camera system
    :math:`(U - Y^T D^{-1} Y)\, \xi = -g_{pose} + Y^T D^{-1} L^{-1} g_{point}`.

    Args:
        system: Normal equations of F poses and P points.
        damping: Factor :math:`\lambda`, a number or shape :math:`(...)`; :math:`\lambda` times the diagonal is added to
            the diagonal. The damping keeps unobservable directions constant, such as the depth of a point that was
            observed once without depth.

    Returns:
        Steps of the poses, shape :math:`(*, ..., 6, F)`, and of the points, shape :math:`(*, ..., 3, P)`.
    """
    F, P = system.U.shape[-1], system.V.shape[-1]
    L, D = _factorise(_damp(system.V, damping))
    h = _forward(L, system.point_gradient[..., None, :])
    Yt = _gather_dense(_forward(gather_columns(L, system.point), system.W), system.pose, system.point, F, P)
    scaled = Yt / D.flatten(-2)[..., None, :]
    U = torch.diag_embed(_damp(system.U, damping)).movedim(-2, -4).transpose(-1, -2)  # F x 6 x F x 6
    S = U.flatten(-2).flatten(-3, -2) - scaled @ Yt.mT
    right = (scaled @ h.flatten(-3)[..., None])[..., 0] - system.pose_gradient.mT.flatten(-2)
    xi = torch.linalg.solve(S, right[..., None])[..., 0]
    rest = h + (Yt.mT @ xi[..., None])[..., 0].unflatten(-1, (3, 1, P))
    delta = _backward(L, -rest / D[..., None, :])
    return xi.unflatten(-1, (F, 6)).mT, delta[..., 0, :]


def _gather_dense(blocks: Tensor, pose: Tensor, point: Tensor, F: int, P: int) -> Tensor:
    """Transposed dense matrix of the 3x6 blocks of all observations: (..., 3, 6, M) to (..., 6 F, 3 P).

    A local map is small, and most of its poses observe many of its points. The points are ordered by coordinate first.
    """
    coordinate, parameter = torch.arange(3, device=pose.device), torch.arange(6, device=pose.device)
    first = (18 * P * pose + point)[..., None, None, :]
    index = first + P * coordinate[:, None, None] + 3 * P * parameter[:, None]
    dense = blocks.new_zeros(*blocks.shape[:-3], 18 * (F + 1) * P)  # an extra pose collects the blocks of fixed poses
    dense = dense.scatter_add(-1, index.flatten(-3), blocks.flatten(-3))
    return dense[..., : 18 * F * P].unflatten(-1, (6 * F, 3 * P))


def _damp(blocks: Tensor, damping: Tensor | float) -> Tensor:
    """Blocks (..., n, n, count) with damped diagonals."""
    diagonal = torch.eye(blocks.shape[-2], dtype=blocks.dtype, device=blocks.device)[..., None]
    factor = torch.as_tensor(damping, dtype=blocks.dtype, device=blocks.device)[..., None, None, None]
    return blocks + diagonal * (factor * blocks + SCHUR_REGULARISATION)


def _factorise(V: Tensor) -> tuple[Tensor, Tensor]:
    """Factors L D L^T of symmetric 3x3 blocks (..., 3, 3, N); faster than LAPACK for small blocks.

    Returns:
        The entries (1, 0), (2, 0) and (2, 1) of L, whose diagonal is 1, and the diagonal of D, both (..., 3, N).
    """
    d0, l10, l20 = V[..., 0, 0, :], V[..., 1, 0, :] / V[..., 0, 0, :], V[..., 2, 0, :] / V[..., 0, 0, :]
    d1 = V[..., 1, 1, :] - l10 * V[..., 1, 0, :]
    l21 = (V[..., 2, 1, :] - l20 * V[..., 1, 0, :]) / d1
    d2 = V[..., 2, 2, :] - l20 * V[..., 2, 0, :] - l21 * l21 * d1
    return torch.stack([l10, l20, l21], dim=-2), torch.stack([d0, d1, d2], dim=-2)


def _forward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L x = b for each block, with L (..., 3, N) as `_factorise` returns it, and b (..., 3, n, N)."""
    (l10, l20, l21), (x, y, z) = L[..., None, :].unbind(-3), b.unbind(-3)
    y = y - l10 * x
    return torch.stack([x, y, z - l20 * x - l21 * y], dim=-3)


def _backward(L: Tensor, b: Tensor) -> Tensor:
    """Solve L^T x = b for each block, with shapes as in `_forward`."""
    (l10, l20, l21), (x, y, z) = L[..., None, :].unbind(-3), b.unbind(-3)
    y = y - l21 * z
    return torch.stack([x - l10 * y - l20 * z, y, z], dim=-3)
