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
"""Minimum fraction of a predicted mask that belongs to no detected object of the class; otherwise the object is not
visible."""


def visible_masks(tracks: Sequence[Track], refined: Mapping[Track, RefinedMask], missing: Tensor) -> list[Tensor]:
    """Return the visible pixels of each object, bool, shape :math:`(H, W)`.

    They are those of the refined mask, if there is one, without the pixels that its margin adds where depth is missing
    or where the network detected another object of the class. A predicted mask lacks all pixels of detected objects of
    its class. It is empty if these have most of it: the network has then drawn one mask over several objects, or the
    object is behind another one.

    Args:
        tracks: Tracks of the frame, detected or missed.
        refined: Refined masks of some of them.
        missing: Pixels without depth, bool, shape :math:`(H, W)`.
    """
    detected = _unions_of_masks(tracks, {track.label for track in tracks if track.missed or track in refined})
    return [torch.from_numpy(_visible_mask(each, refined.get(each), detected, missing.numpy())) for each in tracks]


def _unions_of_masks(tracks: Sequence[Track], labels: set[int]) -> dict[int, NDArray[np.bool_]]:
    """Return the union of the masks of the detected objects of some classes, shape (H, W), by class."""
    unions: dict[int, NDArray[np.bool_]] = {}
    for track in tracks:
        if track.label in labels and not track.missed:
            mask = track.mask.numpy()
            if track.label in unions:
                unions[track.label] |= mask
            else:
                unions[track.label] = mask.copy()
    return unions


def _visible_mask(
    track: Track,
    refined: RefinedMask | None,
    detected: Mapping[int, NDArray[np.bool_]],
    missing: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return the visible pixels of one object, shape (H, W)."""
    own: NDArray[np.bool_] = track.mask.numpy()
    others = detected.get(track.label)
    if track.missed:
        own = own if others is None else own & ~others
        if not track.visible or own.sum() <= _MIN_OWN_FRACTION * track.mask.sum():
            return np.zeros_like(own)
    if refined is None:
        return own
    crop, mask = refined.crop, np.zeros_like(own)
    unclear = missing[crop].copy() if others is None else missing[crop] | others[crop]
    np.greater(unclear, own[crop], out=unclear)  # a & ~b without a copy of b
    np.greater(refined.mask, unclear, out=mask[crop])
    return mask
