"""Which instance of a frame is which object of the frames before: the assignment that is best for all together."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from scipy.optimize import linear_sum_assignment
from torch import Tensor

_OTHER_CLASS = 0.5
"""Extra cost of a pair of different classes: less than a gate or an overlap, so that a class that flickers does not
outweigh the place, but enough to decide between two that are about as likely."""

_FORBIDDEN = 3.0
"""Cost of a pair that cannot be: above all that can, but not far above, or objects would move along to fill gaps."""


def match_instances(
    predicted: Tensor,
    seen: Tensor,
    overlap: Tensor,
    alike: Tensor,
    gate: Tensor,
    least_overlap: float,
    tracked: Tensor | None = None,
    present: Tensor | None = None,
    covered: Tensor | None = None,
    elsewhere: Tensor | None = None,
) -> Tensor:
    """Object that each instance continues.

    An instance may continue an object of its class whose predicted centroid is within the gate, or one of any class,
    however far its centroid, whose mask it overlaps: a centroid jumps when an object is cut or covered. Of all
    assignments the one with the least sum of distances, as shares of the gate and at most 1, of missing overlaps and of
    changes of class is taken; no appearance takes part.

    Args:
        predicted: centroids of T objects, metres, float, shape :math:`(B, T, 3)`; NaN where not known.
        seen: centroids of N instances, shape :math:`(B, N, 3)`; NaN where not known: there the masks alone decide.
        overlap: of their masks, intersection over union, shape :math:`(B, T, N)`.
        alike: pairs of the same class, bool, shape :math:`(B, T, N)`.
        gate: no object gets farther than this from where it is predicted, metres, shape :math:`(B, T)`.
        least_overlap: masks that overlap by this are of one object, whatever the class.
        tracked: which objects exist, bool, shape :math:`(B, T)`; all by default.
        present: which instances exist, bool, shape :math:`(B, N)`; all by default.
        covered: pairs of an object whose place an instance covers: of one class they may be one, however far their
            centroids, bool, shape :math:`(B, T, N)`; none by default.
        elsewhere: pairs of an object that is seen to be where it was predicted, and an instance that lies beside it and
            so is another one, however near; bool, shape :math:`(B, T, N)`; none by default.

    Returns:
        Index of the object, from 0 to T - 1, for each instance, -1 for none; int64, shape :math:`(B, N)`.
    """
    KORNIA_CHECK_SHAPE(predicted, ["B", "T", "3"])
    KORNIA_CHECK_SHAPE(seen, [str(len(predicted)), "N", "3"])
    KORNIA_CHECK_SHAPE(overlap, [str(size) for size in (*predicted.shape[:2], seen.shape[1])])
    KORNIA_CHECK_SHAPE(alike, [str(size) for size in overlap.shape])
    distance = torch.cdist(predicted, seen)
    overlaps = overlap >= least_overlap
    near = (distance <= gate[..., None]) & alike
    if covered is not None:
        near = near | (alike & covered)
    if elsewhere is not None:
        near = near & ~elsewhere
    possible = near | overlaps
    if tracked is not None:
        possible = possible & tracked[..., :, None]
    if present is not None:
        possible = possible & present[..., None, :]
    away = torch.where(distance.isfinite(), distance / gate[..., None], 1.0).clamp(max=1)
    cost = away + (1 - overlap) + _OTHER_CLASS * ~alike
    matched = torch.full(seen.shape[:2], -1)
    for scene, allowed, out in zip(torch.where(possible, cost, _FORBIDDEN).detach(), possible, matched, strict=True):
        rows, columns = map(torch.from_numpy, linear_sum_assignment(scene.numpy()))
        out[columns] = torch.where(allowed[rows, columns], rows, -1)
    return matched
