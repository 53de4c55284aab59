"""Visible masks of detected and of missed objects, with and without a refined mask."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.geometry.packed_masks import pack_masks
from v3d_torch.objects.mask_refiner import RefinedMask
from v3d_torch.objects.result_masks import result_masks
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.segmentation.coco import PERSON

HEIGHT, WIDTH = 60, 80
CHAIR = 56
ALL_MEASURED = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)


def box(rows: tuple[int, int], columns: tuple[int, int]) -> Tensor:
    """Return a mask of a rectangle."""
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def track_of(mask: Tensor, label: int = PERSON, *, missed: bool = False) -> Track:
    """Return a confirmed track with a mask."""
    track = Track(1, 0.0, TrackerConfig(), mask, mask, pack_masks(mask), pack_masks(mask), missed=missed)
    track.update_label(label, 0.9)
    track.add_detection(Detection3D(0.0, torch.zeros(3, dtype=torch.float64), torch.zeros(4, 3)))
    return track


def refined(surface: Tensor, mask: Tensor | None = None) -> RefinedMask:
    """Return a refined mask of rows 4 to 56 and columns 8 to 72; the mask is the surface unless it is given."""
    crop = slice(4, 56), slice(8, 72)
    return RefinedMask(crop, surface.numpy()[crop], (surface if mask is None else mask).numpy()[crop])


def test_object_without_a_refined_mask_has_the_mask_of_the_network() -> None:
    mask = box((10, 50), (20, 40))
    assert torch.equal(result_masks([track_of(mask)], {}, ALL_MEASURED)[0], mask)


def test_refined_mask_replaces_the_mask_of_the_network() -> None:
    track, better = track_of(box((10, 50), (20, 40))), box((14, 52), (24, 48))
    (visible,) = result_masks([track], {track: refined(better)}, ALL_MEASURED)
    assert torch.equal(visible, better)


def test_margin_over_missing_depth_is_not_visible() -> None:
    own, grown = box((10, 50), (20, 40)), box((8, 52), (16, 44))
    track, missing = track_of(own), box((0, 30), (0, 80))
    (visible,) = result_masks([track], {track: refined(grown)}, missing)
    assert torch.equal(visible, own | (grown & ~missing))


@pytest.mark.parametrize(("label", "is_limited"), [(PERSON, True), (CHAIR, False)])
def test_margin_over_another_detected_object_of_the_class_is_not_visible(label: int, is_limited: bool) -> None:
    own, grown, other = box((10, 50), (20, 40)), box((8, 52), (16, 50)), box((10, 50), (42, 60))
    track = track_of(own)
    first, second = result_masks([track, track_of(other, label)], {track: refined(grown)}, ALL_MEASURED)
    assert torch.equal(first, grown & ~other if is_limited else grown)
    assert torch.equal(second, other)


def test_pixels_that_the_network_gives_to_both_objects_stay_visible() -> None:
    own, other = box((10, 50), (20, 40)), box((10, 50), (30, 60))
    track = track_of(own)
    assert torch.equal(result_masks([track, track_of(other)], {track: refined(own)}, ALL_MEASURED)[0], own)


def test_second_object_in_the_mask_of_a_detected_one_is_visible_as_itself() -> None:
    """The network draws one mask over two people; depth shows which pixels belong to which one."""
    both, near, far = box((10, 50), (20, 60)), box((10, 50), (20, 42)), box((10, 50), (40, 60))
    detected, missed = track_of(both), track_of(far, missed=True)
    first, second = result_masks([detected, missed], {detected: refined(near, both)}, ALL_MEASURED)
    assert torch.equal(first, near)
    assert torch.equal(second, far & ~near)
    # Without it, a part at another depth can be an arm.
    assert torch.equal(result_masks([detected], {detected: refined(near, both)}, ALL_MEASURED)[0], both)


@pytest.mark.parametrize(("end", "is_visible"), [(30, True), (29, False)])
def test_predicted_mask_lacks_the_pixels_of_detected_objects_of_its_class(end: int, is_visible: bool) -> None:
    """It is empty if it has half of its pixels, 10 of 20 columns, or fewer."""
    predicted = box((10, 50), (18, 38)) if is_visible else box((10, 50), (19, 39))
    other = box((0, 60), (end, 60))
    missed = track_of(predicted, missed=True)
    visible, _ = result_masks([missed, track_of(other)], {}, ALL_MEASURED)
    assert torch.equal(visible, predicted & ~other if is_visible else torch.zeros_like(predicted))
    # Objects of other classes do not hide it.
    assert torch.equal(result_masks([missed, track_of(other, CHAIR)], {}, ALL_MEASURED)[0], predicted)


def test_invisible_track_has_no_pixels_even_if_its_mask_was_refined() -> None:
    mask = box((10, 50), (20, 40))
    missed = track_of(mask, missed=True)
    missed.is_shown = False
    (visible,) = result_masks([missed], {missed: refined(mask)}, ALL_MEASURED)
    assert visible.shape == (HEIGHT, WIDTH) and not visible.any()


def test_masks_of_the_tracks_are_not_changed() -> None:
    masks = box((10, 50), (20, 40)), box((10, 50), (30, 60))
    tracks = [track_of(mask.clone()) for mask in masks]
    result_masks(tracks, {tracks[0]: refined(masks[0])}, ALL_MEASURED)
    for track, mask in zip(tracks, masks, strict=True):
        assert np.array_equal(track.mask.numpy(), mask.numpy())
