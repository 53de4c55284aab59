"""Data association: optimal assignment of the instances of a frame to object tracks."""

from __future__ import annotations

import scipy.optimize  # loaded here: `scipy` alone would load it while the first frame is tracked
import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_masks, check_shape
from v3d_torch.kernels.compiler import can_read


def match_instances(log_ratio: Tensor, tracked: Tensor | None = None, present: Tensor | None = None) -> Tensor:
    """Match each instance to the object that it continues, if any.

    The assignment maximises the total log-likelihood ratio. A pair whose ratio is not positive is never matched: its
    instance is more likely a new object. SciPy computes the assignment on the host for all devices.

    Args:
        log_ratio: Log-likelihood ratio that instance n continues object t, floating point, shape :math:`(B, T, N)`;
            -inf for impossible pairs, any value for padding.
        tracked: Mask of the objects that are not padding, bool, shape :math:`(B, T)`; None for all.
        present: Mask of the instances that are not padding, bool, shape :math:`(B, N)`; None for all.

    Returns:
        Index of the object that each instance continues, from 0 to T - 1, or -1; int64, shape :math:`(B, N)`.

    Raises:
        InputError: If a mask is not bool, or a ratio that is not padding is NaN or plus infinity.
    """
    check_masks(tracked=tracked, present=present)
    check_shape("log_ratio", log_ratio, "B", "T", "N")
    gain = log_ratio.detach().to(torch.float64).clamp(min=0)
    if tracked is not None:
        check_shape("tracked", tracked, *gain.shape[:2])
        gain = torch.where(tracked[..., :, None], gain, 0.0)
    if present is not None:
        check_shape("present", present, *gain.shape[::2])
        gain = torch.where(present[..., None, :], gain, 0.0)
    return _assign(gain) if can_read(gain) else _assign_on_host(gain)


def _assign(gain: Tensor) -> Tensor:
    """Row of the highest total gain that each column gets, (B, T, N) to (B, N); -1 if its gain is 0."""
    matched = torch.full((gain.shape[0], gain.shape[2]), -1)
    for gains, matches in zip(gain, matched, strict=True):
        try:
            assigned = scipy.optimize.linear_sum_assignment(gains.numpy(), maximize=True)
        except ValueError as error:  # SciPy checks the gains
            raise InputError(
                "log_ratio has NaN or plus infinity; give finite ratios, or -inf for impossible pairs"
            ) from error
        rows, columns = map(torch.from_numpy, assigned)
        matches[columns] = torch.where(gains[rows, columns] > 0, rows, -1)
    return matched


@torch.library.custom_op("v3d_torch::assign", mutates_args=(), schema="(Tensor gain) -> Tensor")
def _assign_on_host(gain: Tensor) -> Tensor:
    """`_assign` as an operator, which compilers call as a whole. It copies the gains from other devices."""
    return _assign(gain.cpu()).to(gain.device)


@_assign_on_host.register_fake
def _(gain: Tensor) -> Tensor:
    return gain.new_empty(gain.shape[0], gain.shape[2], dtype=torch.int64)


@_assign_on_host.register_vmap
def _(info: object, in_dims: tuple[int], gain: Tensor) -> tuple[Tensor, int]:
    gain = gain.movedim(in_dims[0], 0)
    return _assign_on_host(gain.flatten(0, 1)).unflatten(0, gain.shape[:2]), 0
