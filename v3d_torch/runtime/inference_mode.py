"""Inference mode of torch for stored tensors, which are updated in place."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def mode_to_update(tensors: Iterable[Tensor]) -> AbstractContextManager[object]:
    """Return the context in which tensors can be updated in place, whether they were made in inference mode or not.

    Only in inference mode can tensors be updated that were made in it; all other tensors can be updated there, too.

    Args:
        tensors: Stored tensors.

    Returns:
        Inference mode if one of the tensors was made in it; else a context that changes nothing.
    """
    return torch.inference_mode() if any(each.is_inference() for each in tensors) else nullcontext()
