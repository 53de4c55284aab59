"""Products of matrices with many rows, with a result that does not depend on the number of threads."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import pad

_BLOCK = 256
"""Number of rows of one matrix product. On some processors torch splits products of more rows among threads, so that
their rounding depends on the number of threads."""


def sum_products(a: Tensor, b: Tensor) -> Tensor:
    """Product of a transposed matrix and a matrix, both with many rows: the sum of the products of their rows.

    Args:
        a: Matrix, shape :math:`(..., M, I)`.
        b: Matrix of the same dtype, shape :math:`(..., M, J)`.

    Returns:
        Shape :math:`(..., I, J)`.
    """
    rows = a.shape[-2]
    if rows <= _BLOCK:
        return a.mT @ b
    padding = -rows % _BLOCK
    a_blocks, b_blocks = (pad(each, (0, 0, 0, padding)).unflatten(-2, (-1, _BLOCK)) for each in (a, b))
    return (a_blocks.mT @ b_blocks).sum(dim=-3)
