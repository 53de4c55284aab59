"""Matrices of a batch in which some are not finite."""

from __future__ import annotations

import torch
from torch import Tensor


def zero_if_not_finite(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Replace matrices with NaN or infinity by 0: torch raises an error for the whole batch if one is not finite.

    Args:
        matrices: Shape :math:`(..., n, n)`.

    Returns:
        The matrices, and a mask of those that were replaced, bool, shape :math:`(..., 1, 1)`.
    """
    replaced = ~matrices.isfinite().all(dim=-1, keepdim=True).all(dim=-2, keepdim=True)
    return torch.where(replaced, 0.0, matrices), replaced
