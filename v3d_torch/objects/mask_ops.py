"""Operations on image masks: cropping, subsampling, nearest-neighbour upsampling and dilation.

NumPy copies bytes several times faster here than torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.kernels import masks as kernels
from v3d_torch.kernels.compiler import compiled_by

Crop = tuple[slice, slice]
"""Rows and columns of a part of an image; those beyond its last ones do not count."""

_MAX_COMPILED_RADIUS = 254
"""Maximum radius of the compiled dilation, pixels: the kernel stores distances up to the radius plus one as uint8."""


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


@cache
def ellipse(radius: int) -> NDArray[np.uint8]:
    """Elliptic structuring element of a radius, pixels, uint8, shape (2 radius + 1, 2 radius + 1)."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _dilate_compiled(mask: Tensor, pixels: int) -> Tensor:
    if not 0 <= pixels < _MAX_COMPILED_RADIUS:
        return NotImplemented
    source = mask.view(torch.uint8).numpy()
    crop = crop_around(source, pixels)
    dilated = np.zeros_like(source)
    if crop is not None:
        dilated[crop] = kernels.dilate(np.ascontiguousarray(source[crop]), _heights(pixels))
    return torch.from_numpy(dilated).view(torch.bool)


@compiled_by(_dilate_compiled)
def dilate(mask: Tensor, pixels: int) -> Tensor:
    """Dilate a mask by an ellipse.

    Args:
        mask: Mask, bool, shape :math:`(H, W)`.
        pixels: Radius of the dilation, pixels.

    Returns:
        Dilated mask, bool, shape :math:`(H, W)`.
    """
    source = mask.view(torch.uint8).numpy()
    crop = crop_around(source, pixels)
    dilated = np.zeros_like(source)
    if crop is not None:
        dilated[crop] = cv2.dilate(source[crop], ellipse(pixels))
    return torch.from_numpy(dilated).view(torch.bool)


@cache
def _heights(radius: int) -> NDArray[np.uint8]:
    """Height of the ellipse above its centre, in each column from the centre to the right, pixels."""
    return (ellipse(radius)[:, radius:].sum(axis=0) // 2).astype(np.uint8)
