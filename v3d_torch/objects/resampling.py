"""Every n-th pixel of an image, and cells of n x n pixels as an image.

NumPy copies bytes several times faster here than torch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def subsample(images: Tensor, stride: int) -> Tensor:
    """Return every n-th row and column of images or masks, shape :math:`(*, h, w)`.

    Args:
        images: Images, shape :math:`(*, H, W)`.
        stride: Step n between the pixels.
    """
    return torch.from_numpy(np.ascontiguousarray(images.numpy()[..., ::stride, ::stride]))


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
    # Repeat along rows first, because that copies less.
    pixels = cells.repeat(cell_size, axis=-1)[..., :width].repeat(cell_size, axis=-2)[..., :height, :]
    return torch.from_numpy(np.ascontiguousarray(pixels))
