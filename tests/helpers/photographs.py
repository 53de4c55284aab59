"""Photographs of scikit-image as tensors."""

from __future__ import annotations

import skimage.data
import torch
from torch import Tensor


def photograph(name: str) -> Tensor:
    """A photograph of scikit-image, uint8, shape (3, H, W)."""
    return torch.from_numpy(getattr(skimage.data, name)()).permute(2, 0, 1)
