"""Dilation of a mask by an ellipse."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.kernels import masks as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.objects.crops import box_of, crop_around

_MAX_COMPILED_RADIUS = 253
"""Maximum radius of the compiled dilation, pixels: the kernel stores distances up to the radius plus one as uint8."""


@cache
def ellipse(radius: int) -> NDArray[np.uint8]:
    """Elliptic structuring element of a radius, pixels, uint8, shape (2 radius + 1, 2 radius + 1)."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _dilate_compiled(mask: Tensor, pixels: int) -> Tensor:
    heights = ellipse_heights(pixels)
    if heights is None:
        return NotImplemented
    source = to_array(mask.view(torch.uint8))
    crop = crop_around(source, pixels)
    box = (0, 0, 0, 0) if crop is None else box_of(crop, source.shape)
    return torch.from_numpy(kernels.dilate(source, box, heights)).view(torch.bool)


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
def ellipse_heights(radius: int) -> NDArray[np.uint8] | None:
    """Height of the ellipse above its centre, in each column from the centre to the right, pixels, for kernels.

    None if a kernel does not support the radius.
    """
    if not 0 <= radius <= _MAX_COMPILED_RADIUS:
        return None
    return (ellipse(radius)[:, radius:].sum(axis=0) // 2).astype(np.uint8)
