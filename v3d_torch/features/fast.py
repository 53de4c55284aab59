"""FAST corners with an adaptive threshold (Rosten and Drummond, ECCV 2006; Mur-Artal et al., T-RO 2015)."""

from __future__ import annotations

import cv2
import kornia_rs
import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels import fast as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.kernels.fast import RADIUS

_ARC = 9
"""Minimum number of adjacent pixels on the circle around a corner that are all brighter or all darker (FAST-9)."""

_WHITE = 255
"""Grey level of white, by which kornia-rs divides the strength of corners."""

_PIXELS_BEFORE = np.array([[1, 1, 1], [1, 0, 0], [0, 0, 0]], np.uint8)
"""Offsets of the neighbours of a pixel that precede it in row-major order."""

Ints = NDArray[np.int64]


def _detect_corners_compiled(
    image: NDArray[np.uint8], boxes: Ints, threshold: int, min_threshold: int, cell: int
) -> tuple[Ints, Ints]:
    return kernels.detect_corners(np.ascontiguousarray(image), boxes, threshold, min_threshold, cell)


@compiled_by(_detect_corners_compiled)
def detect_corners(
    image: NDArray[np.uint8], boxes: Ints, threshold: int, min_threshold: int, cell: int
) -> tuple[Ints, Ints]:
    """Detect strong corners, and weak corners in cells without a strong one.

    Weak corners lie on surfaces with little contrast. A corner is a local maximum of the strength: the least
    difference of brightness between a pixel and an arc of nine pixels around it, for the best arc. Of equal neighbours,
    the first is the maximum.

    Args:
        image: Grey image, uint8, shape :math:`(H, W)`, or several images below each other.
        boxes: Left, top, right, and bottom of the regions in which corners are detected, sorted by rows, int64, shape
            :math:`(L, 4)`; at least three pixels from the image border. A row of cells intersects at most one of them.
        threshold: Corners with a larger strength are strong, grey levels.
        min_threshold: Pixels with a larger strength are corners, grey levels.
        cell: Side of a cell, pixels.

    Returns:
        Corners (column, row), in row-major order, int64, shape :math:`(N, 2)`, and their strength, grey levels, int64,
        shape :math:`(N,)`.
    """
    strength = np.zeros_like(image)
    for left, top, right, bottom in boxes.tolist():
        region = image[top - RADIUS : bottom + RADIUS, left - RADIUS : right + RADIUS]
        corners, response = kornia_rs.features.fast_detect(region.copy(), min_threshold, _ARC, RADIUS)
        columns, rows = corners.T.astype(np.int64) - RADIUS
        strength[top:bottom, left:right][rows, columns] = (response * _WHITE).round()
    before, after = (cv2.dilate(strength, neighbours) for neighbours in (_PIXELS_BEFORE, _PIXELS_BEFORE[::-1, ::-1]))
    maxima = (strength > before) & (strength >= after)
    # Strongest corner of the cell of each pixel.
    padded = np.pad(strength, [(0, -size % cell) for size in strength.shape])
    cells = padded.reshape(padded.shape[0] // cell, cell, -1, cell).max(axis=(1, 3))
    strongest = cells.repeat(cell, axis=0).repeat(cell, axis=1)[: strength.shape[0], : strength.shape[1]]
    rows, columns = np.nonzero(maxima & ((strength > threshold) | (strongest <= threshold)))
    return np.stack([columns, rows], axis=1), strength[rows, columns].astype(np.int64)
