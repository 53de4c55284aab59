"""Static mask: pixels of a frame that tracking can use, and the subset that shows no person."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import ObjectsConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.mask_ops import dilate
from v3d_torch.objects.mask_refiner import MaskRefiner, RefinedMask
from v3d_torch.objects.newly_occupied import NewlyOccupied
from v3d_torch.objects.track import Track


class StaticMasks(NamedTuple):
    """Static pixels of a frame.

    Attributes:
        static: Pixels outside of all excluded objects, bool, shape :math:`(H, W)`.
        without_people: Pixels of ``static`` at a larger distance from all excluded objects and people, bool, shape
            :math:`(H, W)`.
    """

    static: Tensor
    without_people: Tensor


def static_masks(
    excluded: Sequence[Track],
    people: Sequence[Track],
    view: DepthView,
    newly_occupied: NewlyOccupied,
    config: ObjectsConfig,
    camera: PinholeCamera,
) -> StaticMasks:
    """Compute the static mask of a frame, with and without people.

    Args:
        excluded: Objects that tracking must not use.
        people: People, static or not.
        view: Depth and pose of the frame.
        newly_occupied: Newly occupied pixels of the frame.
        config: Margins and tolerances of the masks, and the spacing of the clouds.
        camera: Camera of the frame.
    """
    # Most excluded objects are people: refine each mask once.
    tracks = list(dict.fromkeys([*excluded, *people]))
    refiner = MaskRefiner(tracks, view, newly_occupied, config.static_mask, camera, config.clouds.voxel_size)
    masks = {track: refiner.refine(track) for track in tracks}
    size, margins = view.depth.shape[-2:], config.static_mask
    static = _outside([masks[track] for track in excluded], size, margins.dilation)
    return StaticMasks(static, static & _outside(list(masks.values()), size, margins.map_dilation))


def _outside(masks: list[RefinedMask], size: torch.Size, dilation: int) -> Tensor:
    """Return the pixels outside of all dilated masks, bool, shape (H, W)."""
    if not masks:
        return torch.ones(size, dtype=torch.bool)
    covered = np.zeros(size, np.bool_)
    for crop, mask in masks:
        covered[crop] |= mask
    outside = dilate(torch.from_numpy(covered), dilation).numpy()
    return torch.from_numpy(np.logical_not(outside, out=outside))
