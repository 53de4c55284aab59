"""Dtype of intermediate results."""

from __future__ import annotations

import torch


def working_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype in which a function computes: float32 for half precision and bfloat16, else the dtype itself.

    Args:
        dtype: Dtype of the inputs, floating point.
    """
    return torch.promote_types(dtype, torch.float32)
