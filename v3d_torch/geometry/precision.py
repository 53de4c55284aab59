"""Dtypes of results and of intermediate results."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

_P = ParamSpec("_P")
_R = TypeVar("_R")


def working_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype in which a function computes: float32 for half precision, bfloat16 and integers, else the dtype.

    Args:
        dtype: Dtype of the inputs.
    """
    return torch.promote_types(dtype, torch.float32)


def result_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype of a function's results: that of its inputs, or float32 for integers, which have no fractions.

    Args:
        dtype: Dtype of the inputs.
    """
    return dtype if dtype.is_floating_point else torch.float32


def without_autocast(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function of tensors of one device that has the same results inside of `torch.autocast` as outside.

    Autocast multiplies float32 matrices in half precision, which would move poses by centimetres.
    """

    @wraps(function)
    def in_full_precision(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = (*args, *kwargs.values())
        device = next((each.device.type for each in given if isinstance(each, Tensor)), "cpu")
        if not torch.amp.is_autocast_available(device) or not torch.is_autocast_enabled(device):
            return function(*args, **kwargs)
        with torch.autocast(device, enabled=False):
            return function(*args, **kwargs)

    return in_full_precision
