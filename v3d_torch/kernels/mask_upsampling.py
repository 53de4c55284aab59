"""Kernel of the upsampling of masks; see `v3d_torch.segmentation.decode`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats32, Ints
from v3d_torch.kernels.compiler import kernel


@kernel("(f4[:,:,::1], i8[:,::1], UniTuple(i8, 2), i8[::1], f4[:,::1], i8[::1], f4[:,::1], b1[:,:,::1])")
def upsample_masks(
    logits: Floats32, boxes: Ints, first: tuple[int, int], row_cells: Ints, row_weights: Floats32,
    column_starts: Ints, column_weights: Floats32, masks: Bools,
) -> None:  # fmt: skip
    """Write the pixels with positive logits inside the boxes, by bilinear interpolation between cells.

    Between two cells of the same sign, all pixels have that sign.

    Args:
        logits: Logits of a section of the cells for each instance, (N, h, w).
        boxes: First and last pixels inside the boxes, (u0, v0, u1, v1) with u0 <= u < u1, (N, 4).
        first: Row and column of the section's first cell.
        row_cells: First of the two rows of cells between which each row of pixels lies, (H,).
        row_weights: Weights of the two rows of cells, (H, 2).
        column_starts: First column of pixels between each column of cells and the next, and W at the end; (cells,).
        column_weights: Weights of the two columns of cells between which each column of pixels lies, (W, 2).
        masks: Masks, False everywhere; changed in place, (N, H, W).
    """
    top, left = first
    line = np.empty(len(column_starts), np.float32)
    for i in range(len(logits)):
        u0, v0, u1, v1 = boxes[i]
        if u0 >= u1:
            continue
        begin = np.searchsorted(column_starts, u0, side="right") - 1
        end = np.searchsorted(column_starts, u1, side="left")
        for v in range(v0, v1):
            row, above, below = row_cells[v] - top, row_weights[v, 0], row_weights[v, 1]
            for column in range(begin, end + 1):
                line[column] = above * logits[i, row, column - left] + below * logits[i, row + 1, column - left]
            for column in range(begin, end):
                first_u, last_u = max(column_starts[column], u0), min(column_starts[column + 1], u1)
                if line[column] > 0 and line[column + 1] > 0:
                    masks[i, v, first_u:last_u] = True
                elif line[column] > 0 or line[column + 1] > 0:
                    for u in range(first_u, last_u):
                        value = column_weights[u, 0] * line[column] + column_weights[u, 1] * line[column + 1]
                        masks[i, v, u] = value > 0
