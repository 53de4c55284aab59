"""Data association: optimal assignment of the instances of a frame to object tracks."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from scipy.optimize import linear_sum_assignment
from torch import Tensor


def match_instances(log_ratio: Tensor, tracked: Tensor | None = None, present: Tensor | None = None) -> Tensor:
    """Match each instance to the object that it continues, if any.

    The assignment maximises the total log-likelihood ratio. A pair whose ratio is not positive is never matched: its
    instance is more likely a new object.

    Args:
        log_ratio: Log-likelihood ratio that instance n continues object t, shape :math:`(B, T, N)`; -inf for impossible
            pairs.
        tracked: Mask of the objects that are not padding, bool, shape :math:`(B, T)`; None for all.
        present: Mask of the instances that are not padding, bool, shape :math:`(B, N)`; None for all.

    Returns:
        Index of the object that each instance continues, from 0 to T - 1, or -1; int64, shape :math:`(B, N)`.
    """
    KORNIA_CHECK_SHAPE(log_ratio, ["B", "T", "N"])
    gain = log_ratio.detach().clamp(min=0)
    if tracked is not None:
        gain = gain * tracked[..., :, None]
    if present is not None:
        gain = gain * present[..., None, :]
    matched = torch.full((gain.shape[0], gain.shape[2]), -1)
    for gains, matches in zip(gain, matched, strict=True):
        rows, columns = map(torch.from_numpy, linear_sum_assignment(gains.numpy(), maximize=True))
        matches[columns] = torch.where(gains[rows, columns] > 0, rows, -1)
    return matched
