"""Selection of corners that are spread over images, by quadtrees (Mur-Artal et al., T-RO 2015)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v3d_torch.kernels import corner_selection as kernels
from v3d_torch.kernels.arrays import Ints
from v3d_torch.kernels.compiler import compiled_by

_DEPTH = 10
"""Depth of the quadtrees; their smallest cells are below a pixel."""

_CELL_BITS = 2 * _DEPTH + 4
"""Bits of the code of a cell: two for each level, and four for the square cells of the first level."""


def select_corners(
    corners: Ints, response: Ints, image: Ints, sizes: Sequence[tuple[int, int]], counts: Sequence[int]
) -> Ints:
    """Select the strongest corner of each cell of a quadtree, for several images at once.

    Cells with several corners are divided into four: all cells of a level while the number of occupied cells stays
    within the number of corners to select, then single cells, those with the most corners first.

    Args:
        corners: Corners (column, row) of all images, int64, shape :math:`(N, 2)`.
        response: Strength of the corners, from 0 to 255, int64, shape :math:`(N,)`; of equal corners of a cell the
            first one is selected.
        image: Index of the image of each corner, int64, shape :math:`(N,)`.
        sizes: Width and height of the M images, pixels.
        counts: Number of corners to select in each image; the division of the last cell can add up to two more.

    Returns:
        Indices of the selected corners, sorted by image, int64, shape :math:`(K,)`.
    """
    code = image << _CELL_BITS | _cell_codes(corners, np.array(sizes)[image])
    return _select_strongest(code, response, np.array(counts))


def _select_strongest_compiled(code: Ints, response: Ints, counts: Ints) -> Ints:
    return kernels.select_corners(code, response, _DEPTH, _CELL_BITS, counts)


@compiled_by(_select_strongest_compiled)
def _select_strongest(code: Ints, response: Ints, counts: Ints) -> Ints:
    """Select the strongest corner of each cell; ``code`` combines the image of a corner and its smallest cell."""
    if len(code) == 0:
        return np.zeros(0, np.int64)
    index = np.lexsort((-response, code))  # stable
    code, image = code[index], code[index] >> _CELL_BITS
    # The cells of a level are the ranges of codes with equal prefixes. A corner is the first of its cell on all levels
    # from the first level on which its prefix differs from that of the corner before it.
    begins = np.zeros(len(code), np.int64)
    begins[1:] = np.maximum(_DEPTH - (_bit_length(code[1:] ^ code[:-1]) - 1) // 2, 0)
    # Number of occupied cells of each image on each level, and the last level on which it is not too large.
    begun = np.bincount(image * (_DEPTH + 2) + begins, minlength=len(counts) * (_DEPTH + 2))
    cells = begun.reshape(len(counts), -1)[:, :-1].cumsum(axis=1)
    level = np.maximum((cells <= counts[:, None]).sum(axis=1) - 1, 0)
    missing = np.where(level < _DEPTH, counts - cells[np.arange(len(counts)), level], 0)
    # Divide further cells, those with the most corners first, until the wanted number is reached.
    above = begins <= level[image]
    below = begins == level[image] + 1
    first = np.flatnonzero(above)
    size, owner, gained = np.diff(first, append=len(code)), image[first], np.add.reduceat(below, first, dtype=np.int64)
    order = np.lexsort((-size, owner))
    gained_before = gained[order].cumsum() - gained[order]
    begin = np.searchsorted(owner, owner)  # the first cell of the same image, in both orders
    divided = np.zeros(len(first), np.bool_)
    divided[order] = gained_before - gained_before[begin] < missing[owner]
    first = np.flatnonzero(above | (below & divided.repeat(size)))
    cell = np.arange(len(first)).repeat(np.diff(first, append=len(code)))
    return np.asarray(index[np.lexsort((index, -response[index], cell))[first]], np.int64)


def _cell_codes(corners: Ints, sizes: Ints) -> Ints:
    """Codes of the smallest cells of corners: two bits for each level, after the index of the square cell.

    Args:
        corners: Corners (column, row), (N, 2).
        sizes: Width and height of the image of each corner, (N, 2).
    """
    width, height = sizes.T
    squares = np.clip(np.rint(width / height), 1, 15).astype(np.int64)
    column = corners[:, 0] * (squares << _DEPTH) // width
    row = (corners[:, 1] << _DEPTH) // height
    inner = (1 << _DEPTH) - 1
    return (column >> _DEPTH) << 2 * _DEPTH | _spread_bits(column & inner) | _spread_bits(row) << 1


def _spread_bits(x: Ints) -> Ints:
    """Insert a zero before each of the lowest 16 bits."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = (x | x << shift) & mask
    return x


def _bit_length(x: Ints) -> Ints:
    """Number of bits of non-negative integers; 0 for 0."""
    return np.frexp(x.astype(np.float64))[1].astype(np.int64)
