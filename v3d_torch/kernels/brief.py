"""Kernel of oriented BRIEF descriptors; see `v3d_torch.features.brief`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bytes, Floats32, Ints, Ints32
from v3d_torch.kernels.compiler import device, kernel

_GATHER_BITS = np.uint64(0x01020408_10204080)
"""Factor that packs eight bytes of 0 or 1: the highest byte of the product contains their bits, the first as the
lowest."""

ROUNDING = np.float32(64.5)
"""Number added to coordinates before truncation: half a pixel, to round, and 64 pixels, to make them positive."""


@device
def _row_moments(row: Bytes) -> tuple[np.int32, np.int32]:
    """Sum of the values of a row multiplied by their position, and their sum."""
    moment = total = np.int32(0)
    for i in range(np.int32(row.size)):
        value = np.int32(row[i])
        moment += np.int32(i) * value
        total += value
    return moment, total


@device
def _direction(image: Bytes, x: int, y: int, half_widths: Ints) -> tuple[float, float]:
    """Cosine and sine of the direction from a corner to the intensity centroid of the disk around it."""
    m10 = m01 = np.int64(0)
    for dy in range(1 - len(half_widths), len(half_widths)):
        half = half_widths[abs(dy)]
        moment, total = _row_moments(image[y + dy, x - half : x + half + 1])
        m10 += np.int64(moment) - half * np.int64(total)
        m01 += dy * np.int64(total)
    norm = math.sqrt(float(m10 * m10 + m01 * m01))
    return (m10 / norm, m01 / norm) if norm > 0 else (1.0, 0.0)


@device
def _rotate(points: Floats32, cosine: np.float32, sine: np.float32, stride: np.int32, offsets: Ints32) -> None:
    """Write the memory offsets of the pixels nearest to rotated points."""
    for i in range(offsets.size):
        x, y = points[0, i], points[1, i]
        # Truncation rounds positive numbers down.
        column = np.int32(cosine * x - sine * y + ROUNDING) - np.int32(ROUNDING)
        row = np.int32(sine * x + cosine * y + ROUNDING) - np.int32(ROUNDING)
        offsets[i] = row * stride + column


@kernel("(u1[:,::1], u1[:,::1], i8[:,::1], f4[:,::1], i8[::1])")
def describe(image: Bytes, smoothed: Bytes, corners: Ints, points: Floats32, half_widths: Ints) -> Bytes:
    """Oriented BRIEF descriptors.

    Args:
        image: Image, (H, W).
        smoothed: Smoothed image, (H, W).
        corners: Corners (column, row), (N, 2).
        points: Test points (x, y) relative to a corner, pixels, (2, 512): the first of each pair, then the second.
        half_widths: Half width of the disk of the intensity centroid, in each row from its centre, pixels.

    Returns:
        Descriptors, (N, 32).
    """
    width = image.shape[1]
    pixels = smoothed.ravel()
    descriptors = np.empty((len(corners), 32), np.uint8)
    offsets, values, bits = np.empty(512, np.int32), np.empty(512, np.uint8), np.empty(256, np.uint8)
    first, second, octets = values[:256], values[256:], bits.view(np.uint64)
    for n in range(len(corners)):
        x, y = corners[n, 0], corners[n, 1]
        cosine, sine = _direction(image, x, y, half_widths)
        _rotate(points, np.float32(cosine), np.float32(sine), np.int32(width), offsets)
        corner = y * width + x
        for i in range(512):
            values[i] = pixels[np.uint64(corner + offsets[i])]
        for i in range(256):
            bits[i] = first[i] < second[i]
        for i in range(32):
            descriptors[n, i] = (octets[i] * _GATHER_BITS) >> np.uint64(56)
    return descriptors
