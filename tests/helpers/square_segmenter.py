"""Segmentation of drawn pictures into squares."""

from __future__ import annotations

import torch

from v3d_torch.types import Instances, RGBDFrame


def squares(frame: RGBDFrame) -> Instances:
    """Return three objects side by side, the left one sliding along the wall."""
    masks = torch.zeros(3, 240, 320, dtype=torch.bool)
    for i, column in enumerate((20 + 4 * frame.index, 130, 220)):
        masks[i, 90:150, column : column + 60] = True
    return Instances(masks, torch.tensor([0, 56, 62]), torch.ones(3), torch.zeros(3, 4))
