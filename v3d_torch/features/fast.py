"""FAST corners with an adaptive threshold (Rosten and Drummond, ECCV 2006; Mur-Artal et al., T-RO 2015)."""

from __future__ import annotations

import cv2
import kornia_rs
import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels import fast as kernels
from v3d_torch.kernels.arrays import Ints
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.kernels.fast import RADIUS

_ARC = 9
"""Minimum number of adjacent pixels on the circle around a corner that are all brighter or all darker (FAST-9)."""

_WHITE = 255
"""Grey level of white, by which kornia-rs divides the strength of corners."""

_PIXELS_BEFORE = np.array([[1, 1, 1], [1, 0, 0], [0, 0, 0]], np.uint8)
"""Offsets of the neighbours of a pixel that precede it in row-major order."""

_CIRCLE = np.array(
    [(0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
     (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3)]
)  # fmt: skip
"""Pixels (column, row) of the circle around a corner."""


def _detect_corners_compiled(
    image: NDArray[np.uint8], boxes: Ints, threshold: int, min_threshold: int, cell: int
) -> tuple[Ints, Ints, NDArray[np.float64]]:
    return kernels.detect_corners(np.ascontiguousarray(image), boxes, threshold, min_threshold, cell)


@compiled_by(_detect_corners_compiled)
def detect_corners(
    image: NDArray[np.uint8], boxes: Ints, threshold: int, min_threshold: int, cell: int
) -> tuple[Ints, Ints, NDArray[np.float64]]:
    """Detect strong corners, and weak corners in cells without a strong one.

    Weak corners lie on surfaces with little contrast. A corner is a local maximum of the strength: the least
    difference of brightness between a pixel and an arc of nine pixels around it, for the best arc. Of equal neighbours,
    the first is the maximum. Between pixels, the maximum is that of the parabola through the strength of three adjacent
    pixels, along rows and along columns: it halves the median error.

    Args:
        image: Grey image, uint8, shape :math:`(H, W)`, or several images below each other.
        boxes: Left, top, right, and bottom of the regions in which corners are detected, sorted by rows, int64, shape
            :math:`(L, 4)`; at least three pixels from the image border. A row of cells intersects at most one of them.
        threshold: Corners with a larger strength are strong, grey levels.
        min_threshold: Pixels with a larger strength are corners, grey levels.
        cell: Side of a cell, pixels.

    Returns:
        Corners (column, row), in row-major order, int64, shape :math:`(N, 2)`; their strength, grey levels, int64,
        shape :math:`(N,)`; and the offsets of the maxima between pixels, at most half a pixel, float64, shape
        :math:`(N, 2)`.
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
    corners = np.stack([columns, rows], axis=1)
    inside = np.zeros(image.shape, np.bool_)
    for left, top, right, bottom in boxes.tolist():
        inside[top:bottom, left:right] = True
    return corners, strength[rows, columns].astype(np.int64), _peak_offsets(image, inside, corners)


def _peak_offsets(image: NDArray[np.uint8], inside: NDArray[np.bool_], corners: Ints) -> NDArray[np.float64]:
    """Offsets of the maxima between pixels, (N, 2); pixels that are not inside the boxes have no strength."""
    steps = np.array([[(-1, 0), (0, 0), (1, 0)], [(0, -1), (0, 0), (0, 1)]])
    columns, rows = np.moveaxis(corners[:, None, None] + steps, -1, 0)
    has_strength, strength = inside[rows, columns], np.zeros_like(rows)
    strength[has_strength] = _strength(image, columns[has_strength], rows[has_strength])
    before, centre, after = np.moveaxis(strength, 2, 0)
    return np.asarray((after - before) / (2 * (2 * centre - before - after)))


def _strength(image: NDArray[np.uint8], columns: Ints, rows: Ints) -> Ints:
    """Strength of pixels, grey levels, (N,)."""
    x, y = np.concatenate([_CIRCLE, _CIRCLE[: _ARC - 1]]).T  # arcs continue across the end of the circle
    difference = image[rows[:, None] + y, columns[:, None] + x].astype(np.int64) - image[rows, columns, None]
    arcs = np.lib.stride_tricks.sliding_window_view(difference, _ARC, axis=1)
    brightest, darkest = arcs.min(axis=2).max(axis=1), -arcs.max(axis=2).min(axis=1)
    return np.asarray(np.maximum(np.maximum(brightest, darkest), 0))
