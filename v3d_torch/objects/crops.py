"""Parts of an image that contain a mask."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Crop = tuple[slice, slice]
"""Rows and columns of a part of an image. They can end beyond the image; slices stop at its border."""


def crop_around(mask: NDArray[np.uint8], margin: int, step: int = 1) -> Crop | None:
    """Return the rows and columns within a margin of the pixels of a mask; None for an empty mask.

    Args:
        mask: Mask of 0 and 1, shape :math:`(H, W)`.
        margin: Margin, pixels.
        step: The rows and columns begin and end at multiples of this.
    """
    left, top, width, height = cv2.boundingRect(mask)
    return (_interval(top, height, margin, step), _interval(left, width, margin, step)) if width else None


def _interval(first: int, count: int, margin: int, step: int) -> slice:
    begin, end = max(first - margin, 0), first + count + margin
    return slice(begin // step * step, -(-end // step) * step)
