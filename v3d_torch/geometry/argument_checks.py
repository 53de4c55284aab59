"""Checks of the arguments of tensor functions. They take no time, because none reads the values of a tensor."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

import torch
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError


def check_shape(name: str, value: object, *dimensions: int | str) -> None:
    """Check the shape of an argument, also if the checks of Kornia are disabled: kernels do not check their indices.

    Args:
        name: Name of the argument.
        value: Tensor.
        dimensions: Sizes; a letter for any size; ``"*"`` first for any number of leading dimensions.

    Raises:
        InputError: If the value is no tensor.
        ShapeError: If it has another shape.
    """
    if not isinstance(value, Tensor):
        expected = _describe_shape(dimensions)
        raise InputError(f"{name} is of type {type(value).__name__}; give a torch.Tensor of shape {expected}")
    has_batch = dimensions[:1] == ("*",)
    last = dimensions[1:] if has_batch else dimensions
    has_dimensions = value.ndim == len(last) or (has_batch and value.ndim > len(last))
    sizes = value.shape[value.ndim - len(last) :]
    if not has_dimensions or any(isinstance(d, int) and d != size for d, size in zip(last, sizes, strict=True)):
        message = f"{name} has the shape {tuple(value.shape)}; give a tensor of shape {_describe_shape(dimensions)}"
        raise ShapeError(message, actual_shape=list(value.shape), expected_shape=[str(d) for d in dimensions])


def _describe_shape(dimensions: Sequence[int | str]) -> str:
    """Return a shape as text, only for errors: a compiler cannot trace the text of a size that changes."""
    return f"({', '.join('...' if d == '*' else str(d) for d in dimensions)})"


def check_masks(**masks: object) -> None:
    """Check that masks are tensors of type bool: an index by a mask of whole numbers would select other elements.

    Args:
        masks: Masks by the name of the argument; None for a mask that was not given.

    Raises:
        InputError: If a mask is no tensor, or not of type bool.
    """
    for name, mask in masks.items():
        given = mask.dtype if isinstance(mask, Tensor) else type(mask).__name__
        if mask is not None and given != torch.bool:
            raise InputError(f"{name} has the type {given}; give a mask of type torch.bool")


def check_positive(**numbers: Tensor | float) -> None:
    """Check that parameters are positive.

    Args:
        numbers: Parameters by the name of the argument; those that are tensors are not checked.

    Raises:
        ConfigError: If a number is not positive, also if it is NaN.
    """
    for name, number in numbers.items():
        if not isinstance(number, Tensor) and not number > 0:
            raise ConfigError(f"{name} is {number}; give a number above 0")


def check_not_negative(**numbers: Tensor | float) -> None:
    """Check that thresholds are at least 0: each comparison with NaN is false, without a message.

    Args:
        numbers: Thresholds by the name of the argument; those that are tensors are not checked.

    Raises:
        ConfigError: If a number is negative or NaN.
    """
    for name, number in numbers.items():
        if not isinstance(number, Tensor) and not number >= 0:
            raise ConfigError(f"{name} is {number}; give a number of at least 0")


def is_count(number: object) -> bool:
    """Check whether a number is whole and at least 0. A kernel would cut off the decimals of a float."""
    return isinstance(number, Integral) and int(number) >= 0


def check_counts(**numbers: float) -> None:
    """Check that parameters are whole numbers of at least 0.

    Args:
        numbers: Parameters by the name of the argument.

    Raises:
        ConfigError: If a number is negative, or of a type with decimals, such as float.
    """
    for name, number in numbers.items():
        if not is_count(number):
            raise ConfigError(f"{name} is {number}; give a whole number of at least 0")


def check_not_jit_traced(function: str) -> None:
    """Check that `torch.jit.trace` does not record a function whose steps depend on sizes or values.

    Args:
        function: Name of the function.

    Raises:
        InputError: If it does.
    """
    if torch.jit.is_tracing():  # type: ignore[attr-defined]  # its type stub lacks it
        raise InputError(f"torch.jit.trace cannot record {function}; use torch.export.export")
