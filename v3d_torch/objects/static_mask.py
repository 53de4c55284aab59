"""Static mask: pixels of a frame that camera tracking can use, and those of them that maps can use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import StaticMaskConfig
from v3d_torch.objects.dilation import dilate
from v3d_torch.objects.mask_refiner import RefinedMask


class StaticMasks(NamedTuple):
    """Static pixels of a frame.

    Attributes:
        static_mask: Pixels outside of all excluded objects, bool, shape :math:`(H, W)`.
        map_mask: Pixels of ``static_mask`` at a larger distance from all excluded objects and people, bool, shape
            :math:`(H, W)`.
    """

    static_mask: Tensor
    map_mask: Tensor


def static_masks(
    excluded: Sequence[RefinedMask], all_masks: Sequence[RefinedMask], size: torch.Size, config: StaticMaskConfig
) -> StaticMasks:
    """Compute the pixels that camera tracking can use, and those of them that can be stored in maps.

    Args:
        excluded: Masks of the objects that camera tracking must not use.
        all_masks: These masks, and those of the other people.
        size: Height and width of the image.
        config: Margins of the masks.
    """
    covered = np.zeros(size, np.bool_)
    _add(excluded, covered)
    static_mask = _outside(covered, config.dilation)
    _add(all_masks, covered)
    return StaticMasks(static_mask, static_mask & _outside(covered, config.map_dilation))


def _add(masks: Sequence[RefinedMask], covered: NDArray[np.bool_]) -> None:
    for each in masks:
        covered[each.crop] |= each.mask


def _outside(covered: NDArray[np.bool_], dilation: int) -> Tensor:
    """Return the pixels outside of a dilated mask, bool, shape (H, W)."""
    return ~dilate(torch.from_numpy(covered), dilation)
