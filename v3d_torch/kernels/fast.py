"""Kernel of FAST corners; see `v3d_torch.features.fast`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bytes, Floats, Ints
from v3d_torch.kernels.compiler import device, kernel

RADIUS = 3
"""Radius of the circle around a corner, pixels."""


@device
def _brightest_arc(circle: tuple[np.uint8, ...]) -> np.uint8:
    """Brightness of the brightest arc, nine adjacent ones of 16 pixels: that of its darkest pixel."""
    c = circle
    pairs = (
        min(c[1], c[2]), min(c[3], c[4]), min(c[5], c[6]), min(c[7], c[8]),
        min(c[9], c[10]), min(c[11], c[12]), min(c[13], c[14]), min(c[15], c[0]),
    )  # fmt: skip
    quads = (
        min(pairs[0], pairs[1]), min(pairs[1], pairs[2]), min(pairs[2], pairs[3]), min(pairs[3], pairs[4]),
        min(pairs[4], pairs[5]), min(pairs[5], pairs[6]), min(pairs[6], pairs[7]), min(pairs[7], pairs[0]),
    )  # fmt: skip
    brightest = np.uint8(0)
    for k in range(8):  # the arcs of the pixels from 2 k + 1 to 2 k + 8, and of the pixel before or after them
        octet = min(quads[k], quads[(k + 2) & 7])
        brightest = max(brightest, min(octet, max(c[2 * k], c[(2 * k + 9) & 15])))
    return brightest


@device
def _add_bright_arcs(rows: tuple[Bytes, ...], strength: Bytes) -> None:
    """Raise the strength of each pixel of a row to the difference between its brightest arc and the pixel.

    The compiler vectorises this loop; a loop with conditions would take longer.

    Args:
        rows: The seven rows around the row, with a margin of the radius on both sides, each (W + 6,).
        strength: Strength so far, (W,); written.
    """
    a, b, c, d, e, f, g = rows
    for x in range(strength.size):
        circle = (
            a[x + 3], a[x + 4], b[x + 5], c[x + 6], d[x + 6], e[x + 6], f[x + 5], g[x + 4],
            g[x + 3], g[x + 2], f[x + 1], e[x], d[x], c[x], b[x + 1], a[x + 2],
        )  # fmt: skip
        centre = d[x + 3]
        strength[x] = max(strength[x], np.uint8(max(_brightest_arc(circle), centre) - centre))


@device
def _measure_strength(image: Bytes, y: int, left: int, right: int, strength: Bytes) -> None:
    """Raise the strength of the pixels of row ``y`` from column ``left`` to ``right``, see `_add_bright_arcs`."""
    columns = slice(left - RADIUS, right + RADIUS)
    rows = (
        image[y - 3, columns], image[y - 2, columns], image[y - 1, columns], image[y, columns],
        image[y + 1, columns], image[y + 2, columns], image[y + 3, columns],
    )  # fmt: skip
    _add_bright_arcs(rows, strength)


@device
def _keep_maxima(above: Bytes, row: Bytes, below: Bytes, limit: Bytes, maxima: Bytes) -> None:
    """Copy the strength of local maxima above a limit, and write 0 for other pixels.

    Of equal neighbours, the first is the maximum. The rows have a margin of one pixel on both sides, (W + 2,).
    """
    for x in range(maxima.size):
        before = max(max(above[x], above[x + 1]), max(above[x + 2], row[x]))
        after = max(max(below[x], below[x + 1]), max(below[x + 2], row[x + 2]))
        centre = row[x + 1]
        maxima[x] = centre if (centre > before) & (centre >= after) & (centre > limit[x]) else np.uint8(0)


@device
def _raise(row: Bytes, maximum: Bytes) -> None:
    """Update a maximum in place."""
    for x in range(maximum.size):
        maximum[x] = max(maximum[x], row[x])


@device
def _peak_offset(before: np.uint8, centre: np.uint8, after: np.uint8) -> float:
    """Offset of the maximum of the parabola through the strength of three adjacent pixels, from the centre, pixels."""
    a, b, c = np.int64(before), np.int64(centre), np.int64(after)
    return (c - a) / (2 * (2 * b - a - c))


@kernel("(u1[:,::1], i8[:,::1], i8, i8, i8)")
def detect_corners(
    image: Bytes, boxes: Ints, threshold: int, min_threshold: int, cell: int
) -> tuple[Ints, Ints, Floats]:
    """Detect corners: strong ones, and weak ones in cells without a strong one.

    Args:
        image: Grey image, (H, W).
        boxes: Left, top, right, and bottom of the regions in which corners are detected, (L, 4), at least three pixels
            from the image border; a row of cells intersects at most one of them.
        threshold: Corners with a larger strength are strong.
        min_threshold: Pixels with a larger strength are corners.
        cell: Side of a cell, pixels.

    Returns:
        Corners (column, row), (N, 2), their strength, (N,), and the offsets of the maxima of the strength, (N, 2).
    """
    width = image.shape[1]
    # Two local maxima are never adjacent.
    found, strengths, count = np.empty(image.size // 4, np.int32), np.empty(image.size // 4, np.uint8), 0
    offsets = np.empty((image.size // 4, 2), np.float64)
    strength = np.empty((cell + 2, width), np.uint8)  # of a row of cells, and of the rows above and below
    strongest, limit, maxima = np.empty(width, np.uint8), np.empty(width, np.uint8), np.empty(width, np.uint8)
    for left, top, right, bottom in boxes:
        inside, around = slice(left, right), slice(left - 1, right + 1)
        for first in range(top // cell * cell, bottom, cell):
            begin, end = max(first, top), min(first + cell, bottom)
            above, below = max(begin - 1, top), min(end + 1, bottom)
            strength[:] = 0
            inverted = ~image[above - RADIUS : below + RADIUS]  # dark arcs are bright in it
            for y in range(above, below):
                row = strength[y - begin + 1, inside]
                _measure_strength(image, y, left, right, row)
                _measure_strength(inverted, y - above + RADIUS, left, right, row)
            strongest[:] = 0
            for i in range(1, end - begin + 1):
                _raise(strength[i], strongest)
            for column in range(0, right, cell):
                columns = slice(column, column + cell)
                limit[columns] = threshold if strongest[columns].max() > threshold else min_threshold
            for i in range(1, end - begin + 1):
                _keep_maxima(
                    strength[i - 1, around], strength[i, around], strength[i + 1, around], limit[inside], maxima[inside]
                )
                for x in range(left, right):
                    if maxima[x]:
                        found[count], strengths[count] = (begin + i - 1) * width + x, maxima[x]
                        offsets[count, 0] = _peak_offset(strength[i, x - 1], maxima[x], strength[i, x + 1])
                        offsets[count, 1] = _peak_offset(strength[i - 1, x], maxima[x], strength[i + 1, x])
                        count += 1
    corners = np.empty((count, 2), np.int64)
    for i in range(count):
        corners[i, 1], corners[i, 0] = divmod(found[i], width)
    return corners, strengths[:count].astype(np.int64), offsets[:count].copy()
