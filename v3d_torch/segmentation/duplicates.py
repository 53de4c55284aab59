"""One object, one instance: a network also reports parts of a person, and the same person twice."""

from __future__ import annotations

import torch

from v3d_torch.types import Instances

_STRIDE = 4
"""Masks are compared on every n-th pixel: an overlap needs no more."""


def without_duplicates(instances: Instances, share: float) -> Instances:
    """Leave out instances that lie within a better one of their class, or that one of another class coincides with.

    Suppression by boxes does not find them: head and shoulders fill a small part of the box of the person.

    Args:
        instances: best score first.
        share: an instance of which more than this lies in a better one is left out.

    Returns:
        The instances that stay, in the same order.
    """
    masks = instances.masks[:, ::_STRIDE, ::_STRIDE].flatten(1).to(torch.float32)
    area = masks.sum(dim=1)
    within = (masks @ masks.T) / area[:, None].clamp(min=1)
    # A person may hold a cup, or hide most of a chair; but what also lies in it is the same thing by another name.
    same = (within > share) & ((instances.labels[:, None] == instances.labels) | (share < within.T))
    kept = torch.zeros(len(instances), dtype=torch.bool)
    for i in range(len(instances)):  # each depends on those before it; there are a few dozen at most
        kept[i] = not (same[i] & kept).any()
    return instances[kept]
