"""Dtypes of results and of intermediate results."""

from __future__ import annotations

import torch


def working_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype in which a function computes: float32 for half precision and bfloat16, else the dtype itself.

    Args:
        dtype: Dtype of the inputs, floating point.
    """
    return torch.promote_types(dtype, torch.float32)


def result_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype of a function's results: that of its inputs, or float32 for integers, which cannot hold them.

    Args:
        dtype: Dtype of the inputs.
    """
    return dtype if dtype.is_floating_point else torch.float32
