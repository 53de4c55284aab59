"""Kernel of exhaustive descriptor matching; see `v3d_torch.features.matching`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Ints, Words
from v3d_torch.kernels.compiler import device, kernel

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


@device
def _measure_distances(a: Words, i: int, columns: tuple[Words, ...], distances: Ints) -> None:
    """Write the distances between descriptor ``a[i]`` and all descriptors whose words are given in columns.

    The compiler vectorises this loop; a loop with conditions would take longer.
    """
    first, second, third, fourth = columns
    for j in range(distances.size):
        distances[j] = (
            _count_bits(a[i, 0] ^ first[j])
            + _count_bits(a[i, 1] ^ second[j])
            + _count_bits(a[i, 2] ^ third[j])
            + _count_bits(a[i, 3] ^ fourth[j])
        )


@device
def _minimum(distances: Ints) -> int:
    """Smallest distance, of at least one."""
    least = distances[0]
    for j in range(distances.size):
        least = min(least, distances[j])
    return least


@device
def _first_of(distances: Ints, distance: int) -> int:
    """Position of the first descriptor at a distance; there is one."""
    position = 0
    while distances[position] != distance:
        position += 1
    return position


@kernel("(u8[:,::1], u8[:,::1], i8, f8)")
def match_descriptors(a: Words, b: Words, max_hamming: int, max_ratio: float) -> Ints:
    """Pairs of mutual nearest neighbours that pass the ratio test, sorted by the row of ``a``, (K, 2).

    Args:
        a: Descriptors, (N, 4).
        b: Descriptors, (M, 4).
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: The best distance is less than this fraction of the second-best.
    """
    pairs, count = np.empty((len(a), 2), np.int64), 0
    rows, columns = a.T.copy(), b.T.copy()
    from_a, from_b = np.empty(len(b), np.int64), np.empty(len(a), np.int64)
    for i in range(len(a)):
        _measure_distances(a, i, (columns[0], columns[1], columns[2], columns[3]), from_a)
        best = _minimum(from_a)
        if best > max_hamming:
            continue
        nearest = _first_of(from_a, best)
        from_a[nearest] = MAX_DISTANCE
        if not best < max_ratio * _minimum(from_a):  # also if it is NaN, as in the torch function
            continue
        _measure_distances(b, nearest, (rows[0], rows[1], rows[2], rows[3]), from_b)
        if _minimum(from_b) == best and _first_of(from_b, best) == i:  # the lower row wins ties
            pairs[count, 0], pairs[count, 1] = i, nearest
            count += 1
    return pairs[:count]
