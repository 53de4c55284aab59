"""Parts of an image that contain a mask."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.kernels.masks import Box

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
    return widen((slice(top, top + height), slice(left, left + width)), margin, step) if width else None


def widen(crop: Crop, margin: int, step: int = 1) -> Crop:
    """Return the rows and columns within a margin of a part of an image.

    Args:
        crop: Rows and columns of the part.
        margin: Margin, pixels.
        step: The rows and columns begin and end at multiples of this.
    """
    rows, columns = (
        slice(max(each.start - margin, 0) // step * step, -(-(each.stop + margin) // step) * step) for each in crop
    )
    return rows, columns


def box_of(crop: Crop, size: Sequence[int]) -> Box:
    """Return first and last row (exclusive), and first and last column (exclusive), of a part of an image.

    Args:
        crop: Rows and columns of the part.
        size: Height and width of the image, pixels.
    """
    rows, columns = crop
    return rows.start, min(rows.stop, size[0]), columns.start, min(columns.stop, size[1])
