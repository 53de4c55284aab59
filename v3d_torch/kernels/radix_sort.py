"""Stable sort of whole numbers: part of the kernels that group points by cells of a grid."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Ints
from v3d_torch.kernels.compiler import device

_DIGIT = 11
"""Number of bits of a digit: the counts of all values of a digit fit into the processor's first-level cache."""


@device
def argsort(keys: Ints, bound: int) -> Ints:
    """Return the indices that sort keys in [0, ``bound``], shape (N,); the order of equal keys is kept."""
    order, spare = np.arange(len(keys)), np.empty(len(keys), np.int64)
    begins, shift = np.empty(1 << _DIGIT, np.int64), 0
    while bound >> shift:
        begins[:] = 0
        for key in keys:
            begins[(key >> shift) & (len(begins) - 1)] += 1
        begin = 0
        for digit in range(len(begins)):
            begins[digit], begin = begin, begin + begins[digit]
        for i in order:
            digit = (keys[i] >> shift) & (len(begins) - 1)
            spare[begins[digit]] = i
            begins[digit] += 1
        order, spare, shift = spare, order, shift + _DIGIT
    return order
