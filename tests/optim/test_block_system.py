"""Linear systems of a pose graph: sparse and dense solutions, and their gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from v3d_torch.optim.block_system import solve_block_system


def system(batch: tuple[int, ...], poses: int, edges: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random positive definite blocks and gradients of edges, and a mask of fixed poses."""
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(*batch, edges, 12, 12, generator=generator, dtype=torch.float64)
    gradient = torch.randn(*batch, edges, 12, generator=generator, dtype=torch.float64)
    ends = torch.randint(0, poses, (*batch, edges), generator=generator)
    fixed = torch.rand(*batch, poses, generator=generator) < 0.3
    return J @ J.mT, gradient, torch.stack([ends, (ends + 1) % poses], dim=-1), fixed


@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 2), (0,)])
@pytest.mark.parametrize(("poses", "edges"), [(2, 1), (7, 20), (3, 0)])
def test_sparse_solution_equals_the_dense_one(batch: tuple[int, ...], poses: int, edges: int) -> None:
    blocks, gradient, ends, fixed = system(batch, poses, edges)
    damping = torch.full(batch, 0.1, dtype=torch.float64)
    sparse = solve_block_system(blocks, gradient, ends, fixed, damping, 1e-3)
    dense = solve_block_system(blocks, gradient.requires_grad_(), ends, fixed, damping, 1e-3)
    assert sparse.shape == (*batch, poses, 6)
    torch.testing.assert_close(sparse, dense.detach(), rtol=1e-9, atol=1e-9)
    assert not sparse[fixed].any()


def test_solution_equals_that_of_the_assembled_system() -> None:
    blocks, gradient, ends, _ = system((), 4, 6)
    H, g = torch.zeros(24, 24, dtype=torch.float64), torch.zeros(24, dtype=torch.float64)
    for block, part, (i, j) in zip(blocks, gradient, ends.tolist(), strict=True):
        rows = torch.cat([torch.arange(6 * i, 6 * i + 6), torch.arange(6 * j, 6 * j + 6)])
        H[rows[:, None], rows] += block
        g[rows] += part
    H.diagonal().mul_(1.5).add_(1e-3)
    found = solve_block_system(blocks, gradient, ends, torch.zeros(4, dtype=torch.bool), 0.5, 1e-3)
    torch.testing.assert_close(found.flatten(), torch.linalg.solve(H, -g))


def test_steps_are_differentiable_in_the_gradient() -> None:
    blocks, gradient, ends, fixed = system((), 4, 6)
    arguments = ends, fixed, 0.1, 1e-3
    assert torch.autograd.gradcheck(lambda g: solve_block_system(blocks, g, *arguments), gradient.requires_grad_())
