"""Visible masks: the pixels of each object in the results of a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.objects.mask_refiner import RefinedMask
from v3d_torch.objects.track import Track

_MIN_OWN_FRACTION = 0.5
"""Minimum fraction of a predicted mask that shows no detected object of the class; otherwise the object is hidden."""


def visible_masks(tracks: Sequence[Track], refined: Mapping[Track, RefinedMask], missing: Tensor) -> list[Tensor]:
    """Return the visible pixels of each object, bool, shape :math:`(H, W)`.

    They are the surface of the refined mask, if there is one, without the pixels that its margin adds where depth is
    missing or where the network detected another object of the class. A predicted mask lacks the visible pixels of
    detected objects of its class. It is empty if these are most of it: the object is behind another one.

    Args:
        tracks: Tracks of the frame, detected or missed.
        refined: Refined masks of some of them.
        missing: Pixels without depth, bool, shape :math:`(H, W)`.
    """
    detected = [track for track in tracks if not track.missed]
    segmented = _unions(detected, [track.mask.numpy() for track in detected])
    masks = {
        track: _correct(track.mask.numpy(), refined[track], segmented.get(track.label), missing.numpy())
        if track in refined
        else track.mask.numpy()
        for track in tracks
    }
    shown = _unions(detected, [masks[track] for track in detected])
    missed = {track: _visible_part(track, masks[track], shown.get(track.label)) for track in tracks if track.missed}
    return [torch.from_numpy(missed.get(track, masks[track])) for track in tracks]


def _unions(tracks: Sequence[Track], masks: Sequence[NDArray[np.bool_]]) -> dict[int, NDArray[np.bool_]]:
    """Return the union of the masks of each class, shape (H, W), by class."""
    unions: dict[int, NDArray[np.bool_]] = {}
    for track, mask in zip(tracks, masks, strict=True):
        if track.label in unions:
            unions[track.label] |= mask
        else:
            unions[track.label] = mask.copy()
    return unions


def _correct(
    own: NDArray[np.bool_],
    refined: RefinedMask,
    segmented: NDArray[np.bool_] | None,
    missing: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return the surface of a refined mask without margins over missing depth and other objects, shape (H, W)."""
    crop, mask = refined.crop, np.zeros_like(own)
    unclear = missing[crop].copy() if segmented is None else missing[crop] | segmented[crop]
    np.greater(unclear, own[crop], out=unclear)  # a & ~b without a copy of b
    np.greater(refined.surface, unclear, out=mask[crop])
    return mask


def _visible_part(track: Track, mask: NDArray[np.bool_], shown: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return the visible pixels of a missed object, shape (H, W)."""
    hidden = np.zeros_like(mask) if shown is None else shown
    predicted = track.mask.numpy()
    is_visible = track.visible and (predicted & ~hidden).sum() > _MIN_OWN_FRACTION * predicted.sum()
    return mask & ~hidden if is_visible else np.zeros_like(mask)
