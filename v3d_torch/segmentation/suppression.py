"""Suppression of duplicate detections: by the overlap of boxes, and by the overlap of masks."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.geometry.packed_masks import count_common_pixels, pack_masks
from v3d_torch.types import Instances

_STRIDE = 4
"""Masks are compared on every n-th row and column, pixels: the size of a prototype cell, below which masks have no
detail."""


def non_maximum_suppression(boxes: Tensor, labels: Tensor, iou_threshold: float) -> Tensor:
    """Greedy non-maximum suppression within each class, on all boxes at once.

    A box is kept unless it overlaps a kept box with a higher score. The rule is applied to all boxes at once until
    nothing changes: after pass n at least the first n boxes are final; in practice three or four passes suffice.

    Args:
        boxes: Left, top, right and bottom edges, best score first, pixels, shape :math:`(N, 4)`.
        labels: Class index of each box, int64, shape :math:`(N,)`.
        iou_threshold: Intersection over union above which two boxes overlap.

    Returns:
        Mask of the boxes that are kept, bool, shape :math:`(N,)`.
    """
    overlaps = (_iou(boxes) > iou_threshold) & (labels[:, None] == labels)
    suppresses = overlaps.triu(diagonal=1)  # [i, j]: i is better than j and overlaps it
    keep = torch.ones_like(labels, dtype=torch.bool)
    while True:
        updated = ~(suppresses & keep[:, None]).any(dim=0)
        if torch.equal(updated, keep):
            return keep
        keep = updated


def _iou(boxes: Tensor) -> Tensor:
    """Intersection over union of all pairs of boxes, shape (N, N)."""
    top_left = torch.maximum(boxes[:, None, :2], boxes[:, :2])
    bottom_right = torch.minimum(boxes[:, None, 2:], boxes[:, 2:])
    intersection = (bottom_right - top_left).clamp(min=0).prod(dim=2)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1)
    return intersection / (area[:, None] + area - intersection)


def suppress_duplicates(instances: Instances, max_overlap: float) -> Instances:
    """Remove instances whose mask lies within the mask of a better instance.

    A network also detects parts of a person, or the same person twice. Suppression by boxes does not remove such a
    part: head and shoulders fill a small fraction of the person's box. An instance of another class is removed only if
    the two masks coincide: a person can hold a cup or occlude most of a chair, but two masks of the same pixels are one
    object with two labels.

    Args:
        instances: Instances of one image, best score first.
        max_overlap: Largest fraction of an instance that can lie within a better instance, in [0, 1].

    Returns:
        The remaining instances, in the same order.
    """
    if len(instances) < 2:
        return instances
    packed = pack_masks(instances.masks, _STRIDE)
    intersection = count_common_pixels(packed, packed)
    area = intersection.diagonal()
    contained = intersection / area[:, None].clamp(min=1)  # [i, j]: fraction of i that lies within j
    same_label = instances.labels[:, None] == instances.labels
    duplicates = (contained > max_overlap) & (same_label | (max_overlap < contained.T))
    keep: list[bool] = []
    for row in duplicates.tolist():  # sequential: each decision depends on those before it
        keep.append(not any(is_duplicate and kept for is_duplicate, kept in zip(row, keep, strict=False)))
    return instances[torch.tensor(keep)]
