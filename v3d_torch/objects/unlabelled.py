"""Unlabelled instances: newly occupied regions that no instance of the segmentation covers.

The network misses tilted or partly visible people, and has no class for a carried box. But the points of moving objects
lie in space that an earlier view observed as free. Connected regions of such pixels become instances without a class.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.mask_ops import upsample_nearest
from v3d_torch.objects.newly_occupied import NewlyOccupied
from v3d_torch.segmentation.coco import UNLABELLED
from v3d_torch.types import Instances

_OPENING_KERNEL = np.ones((3, 3), np.uint8)
"""Isolated newly occupied pixels are depth noise; opening by this kernel removes them (pixels of `NewlyOccupied`)."""

_RIM_KERNEL = np.ones((5, 5), np.uint8)
"""Distance within which pixels belong to the contour of an instance, which a coarse mask cuts off (pixels of
`NewlyOccupied`)."""


def unlabelled_instances(
    newly_occupied: NewlyOccupied, instances: Instances, depth: Tensor, camera: PinholeCamera, min_area: float
) -> Instances:
    """Propose instances from newly occupied regions that no other instance covers.

    Args:
        newly_occupied: Newly occupied pixels of the frame.
        instances: Instances of the frame from the segmentation.
        depth: Depth of the frame, metres, shape :math:`(1, H, W)`.
        camera: Camera of the frame.
        min_area: Minimum area of a region, square metres; smaller regions are noise.

    Returns:
        Instances of class `UNLABELLED` with score 0 and empty boxes; none if nothing is newly occupied.
    """
    step, (height, width) = newly_occupied.stride, depth.shape[-2:]
    appeared = (newly_occupied.appeared == 1).any(dim=0).to(torch.uint8).numpy()
    appeared = cv2.morphologyEx(appeared, cv2.MORPH_OPEN, _OPENING_KERNEL)
    covered = np.asarray(instances.masks.numpy()[:, ::step, ::step].any(axis=0), np.uint8)
    appeared[cv2.dilate(covered, _RIM_KERNEL) > 0] = 0
    count, region = cv2.connectedComponents(appeared)
    pixel_area = np.square(depth[0, ::step, ::step].to(torch.float64).numpy() * step) / (camera.fx * camera.fy)
    area = np.bincount(region.ravel(), weights=pixel_area.ravel(), minlength=count)
    large = 1 + np.flatnonzero(area[1:] >= min_area)
    if len(large) == 0:
        return Instances.empty(height, width)
    masks = upsample_nearest(region == large[:, None, None], step, (height, width))
    return Instances.from_masks(masks, torch.full((len(large),), UNLABELLED))
