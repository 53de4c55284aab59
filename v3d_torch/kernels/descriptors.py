"""Kernel of exhaustive descriptor matching; see `v3d_torch.features.matching`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels.compiler import device, kernel

Words = NDArray[np.uint64]
"""Descriptors as 64-bit words, (N, 4)."""
Indices = NDArray[np.int64]

MAX_DISTANCE = 1 << 9
"""Exceeds the distance of any two descriptors, bits."""

_ODD_BITS, _BIT_PAIRS, _HALF_BYTES, _BYTES = (
    np.uint64(0x55555555_55555555),
    np.uint64(0x33333333_33333333),
    np.uint64(0x0F0F0F0F_0F0F0F0F),
    np.uint64(0x01010101_01010101),
)


@device
def _count_bits(word: np.uint64) -> int:
    """Number of set bits. The compiler recognises this form and uses the processor's instruction."""
    word = word - ((word >> np.uint64(1)) & _ODD_BITS)
    word = (word & _BIT_PAIRS) + ((word >> np.uint64(2)) & _BIT_PAIRS)
    word = (word + (word >> np.uint64(4))) & _HALF_BYTES
    count: int = np.int64((word * _BYTES) >> np.uint64(56))  # type: ignore[assignment]
    return count


@device
def hamming_distance(a: Words, i: int, b: Words, j: int) -> int:
    """Number of different bits of descriptors ``a[i]`` and ``b[j]``."""
    return (
        _count_bits(a[i, 0] ^ b[j, 0])
        + _count_bits(a[i, 1] ^ b[j, 1])
        + _count_bits(a[i, 2] ^ b[j, 2])
        + _count_bits(a[i, 3] ^ b[j, 3])
    )


@kernel("(u8[:,::1], u8[:,::1], i8, f8)")
def match_descriptors(a: Words, b: Words, max_hamming: int, max_ratio: float) -> Indices:
    """Pairs of mutual nearest neighbours that pass the ratio test, sorted by the row of ``a``, (K, 2).

    Args:
        a: Descriptors, (N, 4).
        b: Descriptors, (M, 4).
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: Maximum ratio of the best to the second-best distance.
    """
    pairs, count = np.empty((len(a), 2), np.int64), 0
    for i in range(len(a)):
        best, second, nearest = MAX_DISTANCE, MAX_DISTANCE, -1
        for j in range(len(b)):
            distance = hamming_distance(a, i, b, j)
            if distance < second:  # rarely true
                if distance < best:
                    best, second, nearest = distance, best, j
                else:
                    second = distance
        if best > max_hamming or best >= max_ratio * second:
            continue
        mutual = True
        for k in range(len(a)):
            if hamming_distance(a, k, b, nearest) < best + (k < i):  # the lower row wins ties
                mutual = False
                break
        if mutual:
            pairs[count, 0], pairs[count, 1] = i, nearest
            count += 1
    return pairs[:count]
