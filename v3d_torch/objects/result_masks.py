"""Masks of the objects in the results of a frame: the pixels in which each object is visible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.objects.crops import Crop
from v3d_torch.objects.mask_refiner import RefinedMask
from v3d_torch.objects.track import Track

_MIN_OWN_FRACTION = 0.5
"""Minimum fraction of a predicted mask that shows no detected object of the class; otherwise the object is hidden."""

_WHOLE_IMAGE: Crop = (slice(None), slice(None))


def result_masks(tracks: Sequence[Track], refined: Mapping[Track, RefinedMask], missing: Tensor) -> list[Tensor]:
    """Return the visible pixels of each object, bool, shape :math:`(H, W)`.

    An object has its refined mask, if there is one, without the pixels that the margin adds where depth is missing or
    where the network detected another object of the class. From a predicted mask, the surfaces of detected
    objects of the class are removed. If they cover most of it, the object is behind another one, and its mask is empty.
    Otherwise its pixels are removed from the detected objects: the network sometimes draws one mask over two objects.

    Args:
        tracks: Tracks of the frame, detected or missed.
        refined: Refined masks of some of them.
        missing: Pixels without depth, bool, shape :math:`(H, W)`.
    """
    predicted = [track for track in tracks if track.missed and track.is_shown]
    # Only masks of these classes are changed.
    labels = {track.label for track in (*refined, *predicted)}
    detected = [track for track in tracks if not track.missed and track.label in labels]
    segmented = _unions(detected, [_segmented(track, refined.get(track)) for track in detected], missing.shape)
    masks = {track: track.mask.numpy() for track in tracks if not track.missed}
    for track in (*detected, *predicted):
        masks[track] = _corrected(track, refined.get(track), segmented.get(track.label), missing.numpy())
    if predicted:
        surfaces = _unions(detected, [_surface(track, refined.get(track)) for track in detected], missing.shape)
        for track in predicted:
            masks[track] = _visible_part(track, masks[track], surfaces.get(track.label))
        behind = _unions(predicted, [(_WHOLE_IMAGE, masks[track]) for track in predicted], missing.shape)
        for track in detected:
            if track.label in behind:
                masks[track] = masks[track] & ~behind[track.label]
    return [torch.from_numpy(masks[track]) if track in masks else torch.zeros_like(missing) for track in tracks]


def _unions(
    tracks: Sequence[Track], parts: Sequence[tuple[Crop, NDArray[np.bool_]]], size: Sequence[int]
) -> dict[int, NDArray[np.bool_]]:
    """Return the union of the masks of each class, (H, W), by class; each mask is given in a part of the image."""
    unions = {track.label: np.zeros(size, np.bool_) for track in tracks}
    for track, (crop, mask) in zip(tracks, parts, strict=True):
        unions[track.label][crop] |= mask
    return unions


def _segmented(track: Track, refined: RefinedMask | None) -> tuple[Crop, NDArray[np.bool_]]:
    """Return a part of the image that contains the mask of an object, and the pixels of the mask there."""
    crop = _WHOLE_IMAGE if refined is None else refined.crop
    return crop, track.mask.numpy()[crop]


def _corrected(
    track: Track, refined: RefinedMask | None, segmented: NDArray[np.bool_] | None, missing: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the refined mask of an object without margins over missing depth and other objects, shape (H, W)."""
    own: NDArray[np.bool_] = track.mask.numpy()
    if refined is None:
        return own
    crop, mask = refined.crop, np.zeros_like(own)
    unclear = missing[crop].copy() if segmented is None else missing[crop] | segmented[crop]
    np.greater(unclear, own[crop], out=unclear)  # a & ~b without a copy of b
    np.greater(refined.mask, unclear, out=mask[crop])
    return mask


def _surface(track: Track, refined: RefinedMask | None) -> tuple[Crop, NDArray[np.bool_]]:
    """Return a part of the image, and the pixels of an object there, without the other parts of its refined mask."""
    return (_WHOLE_IMAGE, track.mask.numpy()) if refined is None else (refined.crop, refined.surface)


def _visible_part(track: Track, mask: NDArray[np.bool_], surfaces: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return the pixels of a predicted mask that show none of the surfaces of detected objects, shape (H, W)."""
    if surfaces is None:
        return mask
    predicted = track.mask.numpy()
    is_visible = (predicted & ~surfaces).sum() > _MIN_OWN_FRACTION * predicted.sum()
    return mask & ~surfaces if is_visible else np.zeros_like(mask)
