"""Inference mode of torch: of stored tensors, which are updated in place, and of functions that other threads run."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

_P = ParamSpec("_P")
_R = TypeVar("_R")


def mode_to_update(tensors: Iterable[Tensor]) -> AbstractContextManager[object]:
    """Return the context in which tensors can be updated in place, whether they were made in inference mode or not.

    Only in inference mode can tensors be updated that were made in it; all other tensors can be updated there, too.

    Args:
        tensors: Stored tensors.

    Returns:
        Inference mode if one of the tensors was made in it; else a context that changes nothing.
    """
    return torch.inference_mode() if any(each.is_inference() for each in tensors) else nullcontext()


def in_current_mode(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that runs in the inference mode of this thread, whichever thread calls it."""
    inference = torch.is_inference_mode_enabled()

    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with torch.inference_mode(inference):
            return function(*args, **kwargs)

    return run
