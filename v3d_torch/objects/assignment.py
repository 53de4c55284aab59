"""Data association: optimal assignment of the instances of a frame to object tracks."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from scipy.optimize import linear_sum_assignment
from torch import Tensor

_CLASS_CHANGE_COST = 0.5
"""Extra cost of a pair of different classes. It is less than the cost of a whole gate or of a missing overlap, so that
a flickering class does not outweigh the position, but it decides between two pairs of similar distance and overlap."""

_FORBIDDEN_COST = 3.0
"""Cost of a pair that is not allowed. It is above the largest cost of an allowed pair, 2.5, but only slightly: a much
larger cost would shift whole chains of matches to avoid a single forbidden pair."""


def match_instances(
    predicted: Tensor,
    observed: Tensor,
    overlap: Tensor,
    same_class: Tensor,
    gate: Tensor,
    min_overlap: float,
    tracked: Tensor | None = None,
    present: Tensor | None = None,
    covered: Tensor | None = None,
    excluded: Tensor | None = None,
) -> Tensor:
    """Match each instance to the object that it continues, if any.

    An instance can continue an object of its own class if the predicted centroid of the object lies within the gate. It
    can continue an object of any class, at any distance, if their masks overlap: the centroid jumps when an object is
    cut by the image border or occluded. Among all allowed assignments, the one with the smallest total cost is
    chosen. The cost of a pair is the distance as a fraction of the gate, at most 1, plus the missing overlap, plus a
    constant if the classes differ. Appearance is not used.

    Args:
        predicted: Predicted centroids of T objects, metres, float, shape :math:`(B, T, 3)`; NaN if unknown.
        observed: Centroids of N instances, metres, shape :math:`(B, N, 3)`; NaN if unknown. Pairs without both
            centroids are matched by their masks alone.
        overlap: Intersection over union of the masks, shape :math:`(B, T, N)`.
        same_class: Pairs of the same class, bool, shape :math:`(B, T, N)`.
        gate: Largest distance between predicted and observed centroid, metres, shape :math:`(B, T)`.
        min_overlap: Overlap from which a pair is allowed, whatever the classes.
        tracked: Objects that exist, bool, shape :math:`(B, T)`; all by default.
        present: Instances that exist, bool, shape :math:`(B, N)`; all by default.
        covered: Pairs in which the instance covers the predicted mask of the object. Such a pair is allowed if the
            classes are the same, whatever the distance. Bool, shape :math:`(B, T, N)`; none by default.
        excluded: Pairs in which the object is visible at its predicted position and the instance lies beside it. Such
            a pair is not allowed by its distance. Bool, shape :math:`(B, T, N)`; none by default.

    Returns:
        Index of the object that each instance continues, from 0 to T - 1, or -1; int64, shape :math:`(B, N)`.
    """
    KORNIA_CHECK_SHAPE(predicted, ["B", "T", "3"])
    KORNIA_CHECK_SHAPE(observed, [str(len(predicted)), "N", "3"])
    KORNIA_CHECK_SHAPE(overlap, [str(size) for size in (*predicted.shape[:2], observed.shape[1])])
    KORNIA_CHECK_SHAPE(same_class, [str(size) for size in overlap.shape])
    distance = torch.cdist(predicted, observed)
    near = (distance <= gate[..., None]) & same_class
    if covered is not None:
        near = near | (same_class & covered)
    if excluded is not None:
        near = near & ~excluded
    allowed = near | (overlap >= min_overlap)
    if tracked is not None:
        allowed = allowed & tracked[..., :, None]
    if present is not None:
        allowed = allowed & present[..., None, :]
    distance_cost = torch.where(distance.isfinite(), distance / gate[..., None], 1.0).clamp(max=1)
    cost = distance_cost + (1 - overlap) + _CLASS_CHANGE_COST * ~same_class
    cost = torch.where(allowed, cost, _FORBIDDEN_COST).detach()
    matched = torch.full(observed.shape[:2], -1)
    for cost_matrix, allowed_pairs, matches in zip(cost, allowed, matched, strict=True):
        rows, columns = map(torch.from_numpy, linear_sum_assignment(cost_matrix.numpy()))
        matches[columns] = torch.where(allowed_pairs[rows, columns], rows, -1)
    return matched
