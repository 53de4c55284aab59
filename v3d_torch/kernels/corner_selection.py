"""Kernels of the selection of corners; see `v3d_torch.features.corner_selection`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bools, Ints
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.radix_sort import argsort


@device
def _divide_fullest(sizes: Ints, gains: Ints, missing: int) -> Bools:
    """Choose the cells to divide, those with the most corners first, until the wanted number is reached."""
    divided, gained = np.zeros(len(sizes), np.bool_), 0
    largest = sizes.max()
    for cell in argsort(largest - sizes, largest):
        if gained >= missing:
            break
        divided[cell], gained = True, gained + gains[cell]
    return divided


@device
def _choose_cells(begins: Ints, depth: int, count: int) -> Bools:
    """Choose the cells of one image: True for the first corner of each.

    Args:
        begins: First level on which each corner begins a cell, in the order of their cells, (N,), at least one corner.
        depth: Deepest level.
        count: Number of corners to select.
    """
    begun = np.zeros(depth + 2, np.int64)
    for level in begins:
        begun[level] += 1
    level, cells = 0, begun[0]
    while level < depth and cells + begun[level + 1] <= count:
        level += 1
        cells += begun[level]
    sizes, gains, cell = np.zeros(cells, np.int64), np.zeros(cells, np.int64), -1
    for i in range(len(begins)):
        cell += begins[i] <= level
        sizes[cell] += 1
        gains[cell] += begins[i] == level + 1
    divided = _divide_fullest(sizes, gains, count - cells if level < depth else 0)
    chosen, cell = np.empty(len(begins), np.bool_), -1
    for i in range(len(begins)):
        cell += begins[i] <= level
        chosen[i] = begins[i] <= level or (begins[i] == level + 1 and divided[cell])
    return chosen


@kernel("(i8[::1], i8[::1], i8, i8, i8[::1])")
def select_corners(code: Ints, response: Ints, depth: int, cell_bits: int, counts: Ints) -> Ints:
    """Select the strongest corner of each cell of quadtrees.

    Args:
        code: Code of the smallest cell of each corner: the image, then its cell, (N,).
        response: Strength of the corners, (N,).
        depth: Deepest level of the quadtrees.
        cell_bits: Number of bits of the cell.
        counts: Number of corners to select in each image, (M,).

    Returns:
        Indices of the selected corners, sorted by image.
    """
    order = argsort(code, len(counts) << cell_bits)
    begins = np.zeros(len(code), np.int64)
    for i in range(1, len(code)):
        difference, begins[i] = code[order[i]] ^ code[order[i - 1]], depth + 1
        while difference and begins[i] > 0:
            difference, begins[i] = difference >> 2, begins[i] - 1
    selected, found = np.empty(len(code), np.int64), 0
    begin = 0
    while begin < len(code):
        image, end = code[order[begin]] >> cell_bits, begin + 1
        while end < len(code) and code[order[end]] >> cell_bits == image:
            end += 1
        chosen = _choose_cells(begins[begin:end], depth, counts[image])
        for i in range(begin, end):
            corner, strongest = order[i], selected[found - 1]
            if chosen[i - begin]:
                selected[found] = corner
                found += 1
            elif response[corner] > response[strongest] or (
                response[corner] == response[strongest] and corner < strongest
            ):
                selected[found - 1] = corner
        begin = end
    return selected[:found]
