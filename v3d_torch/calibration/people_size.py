"""Apparent size of people, which shows a wrong depth scale: images alone do not determine it, but people do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.frame_objects import TrackedObject
from v3d_torch.segmentation.coco import PERSON

_MIN_OBSERVATIONS = 15
"""Minimum number of observations of people: single ones can be pictures, toys or wrong detections."""

_LARGEST = 2.6
"""Size that half of the people do not exceed, metres, even with raised arms or if two people have one mask."""

_SMALLEST = 0.4
"""Size that one of twenty people exceeds, metres: a head with shoulders. Others are covered, or partly out of view."""


def apparent_sizes(objects: Iterable[TrackedObject], depth: Tensor, camera: PinholeCamera) -> list[float]:
    """Measure each detected person: the longer side of the bounding box of the mask at its median depth.

    Args:
        objects: Objects of a frame.
        depth: Depth of the frame, metres, shape :math:`(1, H, W)`; 0 = no measurement.
        camera: Camera of the frame.

    Returns:
        Size of each person with depth, metres.
    """
    sizes, metres = [], depth[0].numpy()
    for each in objects:
        if each.label != PERSON or each.missed:
            continue
        mask = each.mask.numpy()
        measured = metres[mask & (metres > 0)]
        if len(measured):
            rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
            height, width = (rows[-1] - rows[0] + 1) / camera.fy, (columns[-1] - columns[0] + 1) / camera.fx
            sizes.append(float(np.median(measured) * max(height, width)))
    return sizes


def check_people_size(sizes: Sequence[float], camera: PinholeCamera) -> list[str]:
    """Compare the sizes of people with what is possible.

    Args:
        sizes: Sizes by `apparent_sizes`, metres.
        camera: Camera of the frames. Without a depth scale, depth is in metres and is not checked.

    Returns:
        A sentence with the likely cause, if the sizes are not possible.
    """
    if camera.depth_scale is None or len(sizes) < _MIN_OBSERVATIONS:
        return []
    median, high = (float(np.quantile(sizes, q)) for q in (0.5, 0.95))
    if median > _LARGEST:
        return [
            f"half of the people seem to be larger than {median:.2g} m; the depth_scale {camera.depth_scale:g} seems to"
            " be too small"
        ]
    if high < _SMALLEST:
        return [
            f"nearly all people seem to be smaller than {high:.2g} m; the depth_scale {camera.depth_scale:g} seems to"
            " be too large"
        ]
    return []
