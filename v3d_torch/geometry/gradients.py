"""Derivatives of results that were computed without them."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.kernels.compiler import is_transformed


def needs_gradient(*tensors: Tensor) -> bool:
    """Check whether derivatives with respect to any of the tensors are tracked."""
    if is_transformed():
        return True
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def zero_with_gradient(step: Tensor) -> Tensor:
    """Return zero with the derivatives of a Newton step, whose value at the optimum is only the error of the solver."""
    return step - step.detach()
