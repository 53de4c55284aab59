"""Unlabelled instances: regions that appeared, and that no instance of the segmentation accounts for.

The network misses tilted or partly visible people, and has no class for a carried box. But the points of moving objects
lie in space that an earlier view observed as free. Connected regions of such pixels become instances without a class.
A person or animal accounts for all such pixels in its mask. A thing accounts for them only if it has moved itself:
otherwise something else is in front of it, such as a box before a cupboard, or only this part of its mask moves.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.packed_masks import count_common_pixels, count_pixels, pack_masks, unpack_mask
from v3d_torch.objects.appeared_pixels import MIN_REGION_SIDE, AppearedPixels
from v3d_torch.objects.motion_evidence import MOVED_FRACTION
from v3d_torch.objects.resampling import upsample_nearest
from v3d_torch.segmentation.coco import RIGID, UNLABELLED
from v3d_torch.types import Instances

_OPENING_KERNEL = np.ones((MIN_REGION_SIDE, MIN_REGION_SIDE), np.uint8)
"""Isolated pixels that appeared are depth noise; opening by this kernel removes them (pixels of `AppearedPixels`)."""

_RIM_KERNEL = np.ones((5, 5), np.uint8)
"""Distance within which pixels belong to the contour of an instance, which a coarse mask cuts off (pixels of
`AppearedPixels`)."""


def unlabelled_instances(
    appeared_pixels: AppearedPixels, instances: Instances, depth: Tensor, camera: PinholeCamera, min_area: float
) -> Instances:
    """Propose instances from regions that appeared, and that no other instance accounts for.

    Args:
        appeared_pixels: Pixels of the frame that appeared.
        instances: Instances of the frame, from the segmenter or propagated from the previous frame.
        depth: Depth of the frame, metres, shape :math:`(1, H, W)`.
        camera: Camera of the frame.
        min_area: Minimum area of a region, square metres; smaller regions are noise.

    Returns:
        Instances of class `UNLABELLED` with score 0 and empty boxes; none if nothing appeared.
    """
    stride, (height, width) = appeared_pixels.stride, depth.shape[-2:]
    seen = appeared_pixels.appeared.numpy().view(np.uint8)
    appeared = np.asarray(cv2.morphologyEx(seen, cv2.MORPH_OPEN, _OPENING_KERNEL), np.uint8)
    if not appeared.any():
        return Instances.empty(height, width)
    accounted = _accounted_pixels(instances.labels, pack_masks(instances.masks, stride), appeared)
    appeared[cv2.dilate(accounted, _RIM_KERNEL) > 0] = 0
    count, region = cv2.connectedComponents(appeared)
    pixel_area = np.square(depth[0, ::stride, ::stride].to(torch.float64).numpy() * stride) / (camera.fx * camera.fy)
    area = np.bincount(region.ravel(), weights=pixel_area.ravel(), minlength=count)
    large = 1 + np.flatnonzero(area[1:] >= min_area)
    if len(large) == 0:
        return Instances.empty(height, width)
    masks = upsample_nearest(region == large[:, None, None], stride, (height, width))
    return Instances.from_masks(masks, torch.full((len(large),), UNLABELLED))


def _accounted_pixels(labels: Tensor, packed: Tensor, appeared: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the pixels of the instances that can move by themselves, or of which most appeared.

    Args:
        labels: Class indices of N instances, int64, shape (N,).
        packed: Pixels of the instances, packed, see `pack_masks`, uint8, shape (N, B).
        appeared: Pixels that appeared, 0 or 1, shape (h, w).

    Returns:
        0 or 1, shape (h, w).
    """
    new = count_common_pixels(packed, pack_masks(torch.from_numpy(appeared.view(np.bool_))[None]))[:, 0]
    is_rigid = torch.tensor([label in RIGID for label in labels.tolist()], dtype=torch.bool)
    accounts = ~is_rigid | (new >= MOVED_FRACTION * count_pixels(packed))
    accounted = np.bitwise_or.reduce(packed[accounts].numpy(), axis=0)
    return unpack_mask(torch.from_numpy(accounted), appeared.shape).view(torch.uint8).numpy()
