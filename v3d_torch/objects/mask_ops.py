"""Operations on image masks: nearest-neighbour upsampling and dilation."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def upsample_nearest(cells: NDArray[np.generic], cell_size: int, image_size: Sequence[int]) -> Tensor:
    """Upsample a grid of square cells to pixels.

    Args:
        cells: Values of the cells, shape :math:`(..., h, w)`.
        cell_size: Side of a cell, pixels.
        image_size: Height and width of the image, pixels; the last cells can be cut off.

    Returns:
        Value of the cell at each pixel, dtype of ``cells``, shape :math:`(..., H, W)`.
    """
    height, width = image_size
    # Along rows first, because that copies little. NumPy's repeat is faster here than torch's.
    pixels = cells.repeat(cell_size, axis=-1)[..., :width].repeat(cell_size, axis=-2)[..., :height, :]
    return torch.from_numpy(np.ascontiguousarray(pixels))


def dilate(mask: Tensor, pixels: int) -> Tensor:
    """Dilate a mask by an ellipse.

    Args:
        mask: Mask, bool, shape :math:`(H, W)`.
        pixels: Radius of the dilation, pixels.

    Returns:
        Dilated mask, bool, shape :math:`(H, W)`.
    """
    source = mask.view(torch.uint8).numpy()
    left, top, width, height = cv2.boundingRect(source)
    rows = slice(max(top - pixels, 0), top + height + pixels)
    columns = slice(max(left - pixels, 0), left + width + pixels)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    dilated = np.zeros_like(source)
    if width:
        dilated[rows, columns] = cv2.dilate(source[rows, columns], kernel)
    return torch.from_numpy(dilated).view(torch.bool)
