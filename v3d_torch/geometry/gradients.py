"""Derivatives of results that were computed without them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.kernels.compiler import is_transformed


def needs_gradient(*tensors: Tensor) -> bool:
    """Check whether derivatives with respect to any of the tensors are tracked."""
    if is_transformed():
        return True
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def zero_with_gradient(step: Tensor) -> Tensor:
    """Return zero with the derivatives of a Newton step, whose value at the optimum is only the error of the solver."""
    return step - step.detach()


def without_second_derivatives(tensor: Tensor) -> Tensor:
    """Return a tensor whose gradient cannot be differentiated again: a Newton step has only first derivatives.

    The gradient is that of the tensor. An `InputError` is raised if autograd differentiates it; transforms of
    `torch.func` and compilers are not checked.
    """
    if not needs_gradient(tensor) or is_transformed() or torch.compiler.is_compiling():
        return tensor
    same = tensor.view_as(tensor)
    same.register_hook(_end_derivatives)
    return same


def _end_derivatives(gradient: Tensor | None) -> Tensor | None:
    return gradient if gradient is None or not gradient.requires_grad else _Undifferentiable.apply(gradient)


class _Undifferentiable(torch.autograd.Function):
    """Identity that has no derivative."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        raise InputError("the optimum of a solver has no second derivatives; call backward() without create_graph=True")
