"""Photographs from scikit-image as tensors."""

from __future__ import annotations

import skimage.data
import torch
from torch import Tensor


def photograph(name: str) -> Tensor:
    """Load a photograph from scikit-image by name, uint8 RGB, shape (3, H, W)."""
    return torch.from_numpy(getattr(skimage.data, name)()).permute(2, 0, 1)
