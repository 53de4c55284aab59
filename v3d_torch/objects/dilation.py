"""Dilation of a mask by an ellipse."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.kernels import masks as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.objects.crops import crop_around

_MAX_COMPILED_RADIUS = 253
"""Maximum radius of the compiled dilation, pixels: the kernel stores distances up to the radius plus one as uint8."""


@cache
def ellipse(radius: int) -> NDArray[np.uint8]:
    """Elliptic structuring element of a radius, pixels, uint8, shape (2 radius + 1, 2 radius + 1)."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _dilate_compiled(mask: Tensor, pixels: int) -> Tensor:
    if not 0 <= pixels <= _MAX_COMPILED_RADIUS:
        return NotImplemented
    source = mask.view(torch.uint8).numpy()
    crop = crop_around(source, pixels)
    dilated = np.zeros_like(source)
    if crop is not None:
        dilated[crop] = kernels.dilate(np.ascontiguousarray(source[crop]), ellipse_heights(pixels))
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
def ellipse_heights(radius: int) -> NDArray[np.uint8]:
    """Height of `ellipse` above its centre, in each column from the centre to the right, pixels."""
    return (ellipse(radius)[:, radius:].sum(axis=0) // 2).astype(np.uint8)
