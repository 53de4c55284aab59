"""Padded batches: dimensions, padding, and conversion to the arrays of a kernel."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Number
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_shape
from v3d_torch.kernels.compiler import can_read, to_array

_MAX_ROW_ERROR = 0.01
"""Accepted error of the last row of a camera matrix, which is not used: finite differences change all elements."""


def fill_padding(values: Tensor, valid: Tensor | None, filler: float) -> Tensor:
    """Convert values to float64, and replace the padding, so that it causes neither NaN nor gradients.

    Args:
        values: Any shape.
        valid: Mask of the values that are not padding, a shape that broadcasts; None = all.
        filler: Number to replace padding.
    """
    if values.dtype != torch.float64:  # converting nothing takes time, too
        values = values.to(torch.float64)
    return values if valid is None else torch.where(valid, values, filler)


def mask_or_all(valid: Tensor | None, values: Tensor) -> Tensor:
    """Return a mask, or a mask of all values if it is None."""
    return torch.ones_like(values, dtype=torch.bool) if valid is None else valid


def fill_indices(name: str, indices: Tensor, count: int, valid: Tensor | None) -> Tensor:
    """Replace the padding of indices by 0, after a check of the others: kernels do not check what they read.

    Args:
        name: Name of the indices in error messages.
        indices: Indices from 0 to ``count`` - 1, int64, any shape.
        count: Number of things that the indices refer to.
        valid: Mask of the indices that are not padding, a shape that broadcasts; None = all.

    Raises:
        InputError: If the indices are not int64, or one of them is out of range. The range is checked only if the
            values can be read at once.
    """
    if indices.dtype != torch.int64:
        raise InputError(f"{name} has the type {indices.dtype}; give indices of type torch.int64")
    if can_read(indices) and (valid is None or can_read(valid)):
        outside = (indices < 0) | (indices >= count)
        if valid is not None:
            outside = outside & valid
        if bool(outside.any()):
            first = int(indices.expand(outside.shape)[outside][0])
            raise InputError(f"{name} contains the index {first}; give indices of at least 0 and below {count}")
    return indices if valid is None else torch.where(valid, indices, 0)


def check_finite_arguments(**values: Tensor) -> None:
    """Check that arguments are finite, if they can be read at once: others would make every step of a solver NaN.

    Args:
        values: Arguments by name, any shape.

    Raises:
        InputError: If a value is NaN or infinite.
    """
    for name, each in values.items():
        if can_read(each) and not bool(each.isfinite().all()):
            raise InputError(f"{name} has a value that is not finite; give finite numbers")


def check_weights(weights: Tensor, valid: Tensor) -> None:
    """Check that weights are finite and not negative, if they can be read at once: with others, a cost has no minimum.

    Args:
        weights: Weights of the measurements.
        valid: Mask of the measurements that are not padding, bool, a shape that broadcasts.

    Raises:
        InputError: If the weight of a measurement is negative, infinite or NaN.
    """
    if not (can_read(weights) and can_read(valid)):
        return
    if bool((~(weights >= 0) & valid).any()):
        raise InputError("weights has a value that is negative or NaN; give weights of at least 0")
    if bool((weights.isinf() & valid).any()):
        raise InputError("weights has an infinite value; give finite weights")


def check_sigma(name: str, sigma: Tensor, valid: Tensor) -> None:
    """Check that standard deviations are positive, if they can be read at once: others make every result NaN.

    Args:
        name: Name of the argument.
        sigma: Standard deviations of the measurements.
        valid: Mask of the measurements that are not padding, bool, a shape that broadcasts.

    Raises:
        InputError: If the standard deviation of a measurement is not positive, also if it is NaN.
    """
    if can_read(sigma) and can_read(valid) and bool((~(sigma > 0) & valid).any()):
        raise InputError(f"{name} has a value that is not positive; give standard deviations above 0")


def check_camera_matrix(K: Tensor) -> None:
    """Check that camera matrices are those of a pinhole camera, if they can be read at once.

    Args:
        K: Camera matrices, shape :math:`(*, 3, 3)`.

    Raises:
        InputError: If a value is not finite, a focal length is not positive, or a last row is not (0, 0, 1).
    """
    check_finite_arguments(K=K)
    if can_read(K):
        if not bool((K.diagonal(dim1=-2, dim2=-1)[..., :2] > 0).all()):
            raise InputError("K has a focal length that is not positive; give focal lengths above 0, in pixels")
        if not bool(((K[..., 2, :] - K.new_tensor([0, 0, 1])).abs() <= _MAX_ROW_ERROR).all()):
            raise InputError("K has a last row other than (0, 0, 1); give matrices that are not transposed or scaled")


def fill_weights(weights: Tensor | None, valid: Tensor) -> Tensor:
    """Return weights in float64 after `check_weights`, with 0 for padding.

    Args:
        weights: Weights of the measurements; None for 1.
        valid: Mask of the measurements that are not padding, bool, a shape that broadcasts.
    """
    if weights is None:
        return valid.to(torch.float64)
    check_weights(weights, valid)
    return fill_padding(weights, valid, 0.0)


def fill_fixed(fixed: Tensor | None, T: Tensor) -> Tensor:
    """Return the mask of the poses that an optimiser does not change, bool, shape :math:`(*, P)`.

    Args:
        fixed: The mask; None for the first pose only.
        T: Poses, shape :math:`(*, P, 4, 4)`.
    """
    return torch.arange(T.shape[-3], device=T.device) == 0 if fixed is None else fixed


def check_shapes(**arguments: tuple[Tensor | float | None, *tuple[int | str | None, ...]]) -> torch.Size:
    """Check the shapes of the arguments of a function, and return the broadcast shape of their batches.

    Args:
        arguments: Arguments by name, each with its dimensions without the batch: a number; a letter for a size that is
            the same in all arguments; None for a size that is checked elsewhere. Numbers and None have no shape.

    Raises:
        ShapeError: If an argument has another shape.
        InputError: If an argument is no tensor, number or None, or the batches do not broadcast.
    """
    sizes: dict[str, int] = {}
    for name, (value, *dimensions) in arguments.items():
        known = [sizes.get(str(size), size) for size in dimensions if size is not None]
        if not isinstance(value, Tensor | Number | None):
            check_shape(name, value, "*", *known)  # raises an error, as the value is no tensor
        if isinstance(value, Tensor) and len(known) == len(dimensions):
            check_shape(name, value, "*", *known)
            found = zip(dimensions, value.shape[value.ndim - len(dimensions) :], strict=True)
            sizes |= {letter: size for letter, size in found if isinstance(letter, str)}
    return common_batch(**{name: (value, len(dimensions)) for name, (value, *dimensions) in arguments.items()})


def common_batch(**arguments: tuple[Tensor | float | None, int]) -> torch.Size:
    """Return the broadcast shape of the batches of arguments; faster than torch if those with dimensions are equal.

    Args:
        arguments: Arguments by name, each with its number of dimensions without the batch. Only tensors have a batch.

    Raises:
        InputError: If the batches do not broadcast.
    """
    batches = {
        name: value.shape[: value.ndim - dims]
        for name, (value, dims) in arguments.items()
        if isinstance(value, Tensor) and value.ndim > dims
    }
    first, *others = set(batches.values()) or {torch.Size()}
    if not others:
        return first
    try:
        return torch.broadcast_shapes(first, *others)
    except RuntimeError as error:
        found = ", ".join(f"{name} {tuple(batch)}" for name, batch in batches.items())
        raise InputError(f"the leading dimensions do not broadcast: {found}; give equal ones, or 1") from error


def to_rows(tensor: Tensor, batch: torch.Size) -> NDArray[Any]:
    """Return a batch of tensors as an array in which all batch dimensions are flattened to one."""
    return to_array(tensor.reshape(batch.numel(), *tensor.shape[len(batch) :]) if batch else tensor[None])


def from_rows(rows: Sequence[Sequence[Any]], batch: torch.Size) -> list[Tensor]:
    """Return the results of a kernel as tensors with the batch dimensions, the inverse of `to_rows`.

    Args:
        rows: Results for each problem of the batch, at least one: arrays and numbers.
        batch: Dimensions of the batch.
    """
    if not batch:  # a single problem: nothing to copy
        return [torch.from_numpy(np.asarray(each)) for each in rows[0]]
    columns = (torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))
    return [column.reshape((*batch, *column.shape[1:])) for column in columns]
