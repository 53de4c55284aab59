"""Kernel of the PNG decoder; see `v3d_torch.datasets.png`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bytes
from v3d_torch.kernels.compiler import device, kernel


@kernel("(u1[:,::1], i8, u1[:,::1])")
def undo_filters(filtered: Bytes, channels: int, pixels: Bytes) -> bool:
    """Undo the filters of all rows: each byte is stored as its difference to a prediction from its neighbours.

    Source: PNG specification (W3C, third edition), Sec. 9.

    Args:
        filtered: Type of the filter and stored bytes of each row, (H, 1 + bytes).
        channels: Number of bytes of a pixel.
        pixels: Bytes of the image, changed in place, (H, bytes).

    Returns:
        False if a row has an unknown type of filter.
    """
    above = np.zeros(pixels.shape[1], np.uint8)
    for v in range(len(pixels)):
        kind, stored, row = filtered[v, 0], filtered[v, 1:], pixels[v]
        if kind == 0:
            row[:] = stored
        elif kind == 2:
            for i in range(len(row)):
                row[i] = stored[i] + above[i]
        elif kind <= 4:
            for channel in range(channels):
                left, corner = np.int32(0), np.int32(0)
                for i in range(channel, len(row), channels):
                    up = np.int32(above[i])
                    if kind == 1:
                        predicted = left
                    elif kind == 3:
                        predicted = (left + up) >> 1
                    else:
                        predicted = _paeth(left, up, corner)
                    left = (stored[i] + predicted) & np.int32(255)
                    row[i] = left
                    corner = up
        else:
            return False
        above = row
    return True


@device
def _paeth(left: np.int32, up: np.int32, corner: np.int32) -> np.int32:
    """Return the neighbour that is nearest to left + up - corner, in this order if two are as near.

    This is the specification's rule, written so that the next pixel waits for few operations.
    """
    threshold = np.int32(3) * corner - up - left
    low, high = min(left, up), max(left, up)
    low_or_corner = low if high <= threshold else corner
    return high if threshold <= low else low_or_corner
