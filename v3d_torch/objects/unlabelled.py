"""What moves and has no name: people that the network misses, and things that it does not know.

A tilted or half-seen person, a carried box: no class, no mask. But its points do not fit the camera's motion: they lie
where an earlier view saw nothing. Where such pixels lie together they are proposed as an instance like any other.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.free_space_check import NewlyOccupied
from v3d_torch.objects.mask_ops import upsample_nearest
from v3d_torch.segmentation.coco import UNLABELLED
from v3d_torch.types import Instances

_APART = np.ones((3, 3), np.uint8)
"""Pixels that came alone are noise of the depth; opening by this removes them (pixels of the arrivals)."""

_RIM = np.ones((5, 5), np.uint8)
"""What lies this near to a named instance is its rim, cut off by a coarse mask (pixels of the arrivals)."""


def unlabelled_instances(
    arrivals: NewlyOccupied, named: Instances, depth: Tensor, camera: PinholeCamera, min_area: float
) -> Instances:
    """Regions that came and that no instance covers.

    Args:
        arrivals: of the frame.
        named: instances of the frame.
        depth: metres, shape :math:`(1, H, W)`.
        camera: of the frame.
        min_area: smaller regions are noise, square metres.

    Returns:
        Instances of class `UNLABELLED` with score 0 and empty boxes, none where nothing came.
    """
    step, (height, width) = arrivals.stride, depth.shape[-2:]
    came = (arrivals.appeared == 1).any(dim=0).to(torch.uint8).numpy()
    came = cv2.morphologyEx(came, cv2.MORPH_OPEN, _APART)
    covered = np.asarray(named.masks.numpy()[:, ::step, ::step].any(axis=0), np.uint8)
    came[cv2.dilate(covered, _RIM) > 0] = 0
    count, region = cv2.connectedComponents(came)
    footprint = np.square(depth[0, ::step, ::step].to(torch.float64).numpy() * step) / (camera.fx * camera.fy)
    area = np.bincount(region.ravel(), weights=footprint.ravel(), minlength=count)
    large = 1 + np.flatnonzero(area[1:] >= min_area)
    if len(large) == 0:
        return Instances.empty(height, width)
    masks = upsample_nearest(region == large[:, None, None], step, (height, width))
    return Instances(masks, torch.full((len(large),), UNLABELLED), torch.zeros(len(large)), torch.zeros(len(large), 4))
