"""Linear systems of pose graphs, with a block for each edge: sparse on the CPU, dense elsewhere."""

from __future__ import annotations

import scipy
import torch
from torch import Tensor

from v3d_torch.kernels.compiler import can_read


def solve_block_system(
    blocks: Tensor, gradient: Tensor, edges: Tensor, fixed: Tensor, damping: Tensor | float, regularisation: float
) -> Tensor:
    r"""Solve damped normal equations :math:`H\, \xi = -g` over the free poses.

    Each edge adds its block to the rows and columns of its two poses, 6 for each pose. On the CPU and without
    gradients, the systems of a batch are factorised together by SciPy's SuperLU, which is suitable for some thousands
    of poses. Otherwise they are solved densely, with the same size whatever the values of ``fixed``.

    Args:
        blocks: Part of H of each edge (i, j), shape :math:`(..., E, 12, 12)`: 6 unknowns of i, then 6 of j.
        gradient: Part of g of each edge, shape :math:`(..., E, 12)`.
        edges: Indices (i, j) of the poses of each edge, int64, shape :math:`(..., E, 2)`.
        fixed: Mask of the poses that are fixed, bool, shape :math:`(..., N)`.
        damping: Multiple of the diagonal of H that is added to it, a number or shape :math:`(...)`.
        regularisation: Number that is added to the diagonal of H.

    Returns:
        Steps :math:`\xi` of all poses, 0 for fixed poses, shape :math:`(..., N, 6)`.
    """
    if can_read(blocks) and not gradient.requires_grad:
        return _solve_sparse(blocks, gradient, edges, fixed, damping, regularisation)
    poses = fixed.shape[-1]
    unknown = _unknowns(edges)
    size = 6 * poses
    entries = (unknown[..., :, None] * size + unknown[..., None, :]).flatten(-3)
    H = blocks.new_zeros(*blocks.shape[:-3], size * size).scatter_add(-1, entries, blocks.flatten(-3))
    g = gradient.new_zeros(*blocks.shape[:-3], size).scatter_add(-1, unknown.flatten(-2), gradient.flatten(-2))
    H = H.unflatten(-1, (size, size))
    factor = torch.as_tensor(damping, dtype=H.dtype, device=H.device)[..., None]
    diagonal = H.diagonal(dim1=-2, dim2=-1) * factor + regularisation
    free = ~fixed.repeat_interleave(6, dim=-1)
    # The rows and columns of fixed poses are replaced by those of the identity.
    H = torch.where(free[..., :, None] & free[..., None, :], H, 0.0)
    H = H + torch.diag_embed(torch.where(free, diagonal, 1.0))
    return torch.linalg.solve(H, torch.where(free, -g, 0.0)).unflatten(-1, (poses, 6))


def _unknowns(edges: Tensor) -> Tensor:
    """Index of each of the 12 unknowns of an edge, (..., E, 2) to (..., E, 12)."""
    return (6 * edges[..., None] + torch.arange(6, device=edges.device)).flatten(-2)


def _solve_sparse(
    blocks: Tensor, gradient: Tensor, edges: Tensor, fixed: Tensor, damping: Tensor | float, regularisation: float
) -> Tensor:
    batch, poses = fixed.shape[:-1], fixed.shape[-1]
    # The unknowns of all systems are numbered together; those of fixed poses are negative.
    is_free = ~fixed.reshape(-1)
    rank = torch.where(is_free, is_free.cumsum(dim=0) - 1, -1)
    first = poses * torch.arange(batch.numel())[:, None, None]
    unknown = _unknowns(rank[(edges.reshape(batch.numel(), *edges.shape[-2:]) + first).flatten(0, 1)])
    size, steps = 6 * int(is_free.sum()), gradient.new_zeros(len(is_free), 6)
    if size:
        known = unknown >= 0
        g = torch.zeros(size, dtype=gradient.dtype)
        g.index_add_(0, unknown[known], gradient.reshape(-1, 12)[known])
        rows, columns = unknown[:, :, None].expand(-1, 12, 12), unknown[:, None, :].expand(-1, 12, 12)
        known = (rows >= 0) & (columns >= 0)
        entries = blocks.reshape(-1, 12, 12)[known].numpy(), (rows[known].numpy(), columns[known].numpy())
        H = scipy.sparse.coo_array(entries, shape=(size, size)).tocsc()
        factor = torch.as_tensor(damping, dtype=gradient.dtype).expand(batch)[..., None].expand(fixed.shape)
        factors = factor.reshape(-1)[is_free].repeat_interleave(6).numpy()
        damped = H + scipy.sparse.diags_array(factors * H.diagonal() + regularisation)
        # The matrix is symmetric and positive definite: use a symmetric ordering and no pivoting.
        solver = scipy.sparse.linalg.splu(
            damped.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        steps[is_free] = torch.from_numpy(solver.solve(-g.numpy())).reshape(-1, 6)
    return steps.reshape(*fixed.shape, 6)
