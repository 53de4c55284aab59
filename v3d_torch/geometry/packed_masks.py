"""Masks with one bit per pixel, to count overlaps of many masks fast."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

_WORD = 8
"""Number of bytes compared at a time; packed masks are padded to a multiple of it."""


def pack_masks(masks: Tensor, stride: int = 1) -> Tensor:
    """Pack masks into one bit per pixel.

    Args:
        masks: Masks, bool, shape :math:`(*, H, W)`.
        stride: Every n-th row and column is packed.

    Returns:
        Packed masks, uint8, shape :math:`(*, B)`. Only packed masks of equal H, W and stride are comparable.
    """
    cells = np.ascontiguousarray(masks.numpy()[..., ::stride, ::stride])  # `reshape` alone copies five times slower
    packed = np.packbits(cells.reshape(*cells.shape[:-2], cells.shape[-2] * cells.shape[-1]), axis=-1)
    padding = -packed.shape[-1] % _WORD
    return torch.from_numpy(np.pad(packed, [(0, 0)] * (packed.ndim - 1) + [(0, padding)]) if padding else packed)


def unpack_mask(packed: Tensor, size: Sequence[int]) -> Tensor:
    """Unpack one mask.

    Args:
        packed: Packed mask, uint8, shape :math:`(B,)`.
        size: Number of packed rows and columns, :math:`(h, w)`.

    Returns:
        Mask, bool, shape :math:`(h, w)`.
    """
    pixels = np.unpackbits(packed.numpy(), count=size[0] * size[1])
    return torch.from_numpy(pixels.view(np.bool_).reshape(size[0], size[1]))


def count_pixels(packed: Tensor) -> Tensor:
    """Count the pixels of packed masks, uint8, shape :math:`(*, B)`; returns int64, shape :math:`(*)`."""
    return torch.as_tensor(np.bitwise_count(packed.numpy().view(np.uint64)).sum(axis=-1, dtype=np.int64))


def count_common_pixels(a: Tensor, b: Tensor) -> Tensor:
    """Count the common pixels of all pairs of packed masks.

    Args:
        a: Packed masks, uint8, shape :math:`(M, B)`.
        b: Packed masks, uint8, shape :math:`(N, B)`.

    Returns:
        Number of pixels of each intersection, int64, shape :math:`(M, N)`.
    """
    common = a.numpy().view(np.uint64)[:, None] & b.numpy().view(np.uint64)
    return torch.from_numpy(np.bitwise_count(common).sum(axis=-1, dtype=np.int64))
