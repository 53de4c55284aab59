"""Rules for the values of tensors from user-defined code; values that break one make later stages fail or go wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import are_rigid

_MAX_RIGID_ERROR = 1e-3
"""Maximum difference between R R^T and the identity: transforms computed in float32 are well below."""

_MAX_SUM_ERROR = 1e-3
"""Maximum difference between the sum of a histogram and 1."""


class Rule(NamedTuple):
    """Rule for the values of a tensor.

    Attributes:
        text: What the values must be; follows "has values that are not" in messages.
        holds: Function that checks the values; its second argument are the known sizes by name, see `TensorSpec`.
    """

    text: str
    holds: Callable[[Tensor, Mapping[str, int]], bool]


def _is_inside(pixel: Tensor, sizes: Mapping[str, int]) -> bool:
    size = torch.tensor([sizes["W"], sizes["H"]])
    return bool(((pixel >= 0) & (pixel < size)).all())


def _are_pairs(pairs: Tensor, sizes: Mapping[str, int]) -> bool:
    counts = torch.tensor([sizes["previous"], sizes["current"]])
    return bool(((pairs >= 0) & (pairs < counts)).all())


def _is_rigid(T: Tensor, sizes: Mapping[str, int]) -> bool:
    return bool(are_rigid(T, _MAX_RIGID_ERROR))


def _are_histograms(rows: Tensor, sizes: Mapping[str, int]) -> bool:
    are_sums = (rows >= 0).all(dim=1) & ((rows.sum(dim=1) - 1).abs() < _MAX_SUM_ERROR)
    return rows.shape[1] > 0 and bool((are_sums | rows.isnan().all(dim=1)).all())


FINITE = Rule("finite", lambda values, sizes: bool(values.isfinite().all()))
NOT_NEGATIVE = Rule("finite and at least 0", lambda values, sizes: bool((values.isfinite() & (values >= 0)).all()))
POSITIVE = Rule("positive and finite", lambda values, sizes: bool((values.isfinite() & (values > 0)).all()))
FRACTIONS = Rule("from 0 to 1", lambda values, sizes: bool(((values >= 0) & (values <= 1)).all()))
IDS = Rule("ids or -1", lambda values, sizes: bool((values >= -1).all()))
PIXELS = Rule("pixels of the image", _is_inside)
PAIRS = Rule("indices of features of both frames", _are_pairs)
RIGID = Rule("those of a rigid transform", _is_rigid)
HISTOGRAMS = Rule("at least 0 with sum 1, or NaN", _are_histograms)
