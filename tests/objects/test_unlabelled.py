"""Unlabelled instances from regions that appeared, except for small regions and rims of instances."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.free_space_check import FreeSpaceCheck
from v3d_torch.objects.unlabelled import unlabelled_instances
from v3d_torch.segmentation.coco import COCO_NAMES, PERSON, UNLABELLED, class_name
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=131.25, fy=120.0, cx=79.5, cy=59.5, width=160, height=120)
NO_INSTANCES = Instances.empty(120, 160)
STRIDE = 4


def appeared_in(*regions: tuple[slice, slice], count: int = 2, height: int = 30, width: int = 40) -> AppearedPixels:
    """Regions (rows, columns) that appeared over the last time span; nothing is known over the other time spans."""
    appeared = torch.zeros(count, height, width, dtype=torch.float64)
    appeared[:-1] = torch.nan
    for v, u in regions:
        appeared[-1, v, u] = 1.0
    return AppearedPixels(appeared, STRIDE)


def propose(
    regions: AppearedPixels,
    labelled: Instances = NO_INSTANCES,
    z: float = 2.0,
    min_area: float = 0.02,
    camera: PinholeCamera = CAMERA,
) -> Instances:
    return unlabelled_instances(regions, labelled, torch.full((1, camera.height, camera.width), z), camera, min_area)


def rectangle(rows: slice, columns: slice) -> Tensor:
    mask = torch.zeros(120, 160, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


def instance(mask: Tensor, label: int) -> Instances:
    return Instances(mask[None], torch.tensor([label]), torch.tensor([0.9]), torch.tensor([[60.0, 40.0, 100.0, 80.0]]))


def person(mask: Tensor) -> Instances:
    return instance(mask, PERSON)


REGION = slice(10, 20), slice(15, 25)  # rows and columns of `AppearedPixels`
MASK = rectangle(slice(40, 80), slice(60, 100))  # the same pixels of the image


def test_region_that_appeared_is_an_unlabelled_instance() -> None:
    proposed = propose(appeared_in(REGION))
    assert torch.equal(proposed.masks, MASK[None]) and proposed.masks.dtype == torch.bool
    assert proposed.labels.tolist() == [UNLABELLED] and proposed.labels.dtype == torch.int64
    assert proposed.scores.tolist() == [0.0] and proposed.scores.dtype == torch.float32
    assert proposed.boxes.tolist() == [[0.0] * 4] and proposed.boxes.dtype == torch.float32


def test_separate_regions_are_separate_instances() -> None:
    regions = [REGION, (slice(0, 5), slice(0, 6)), (slice(22, 30), slice(30, 40))]
    proposed = propose(appeared_in(*regions))
    assert len(proposed) == 3
    assert (proposed.masks.sum(dim=0) <= 1).all()
    assert {int(mask.sum()) for mask in proposed.masks} == {1600, 16 * 30, 16 * 80}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_region_over_one_time_span_is_proposed(count: int) -> None:
    assert len(propose(appeared_in(REGION, count=count))) == 1


def test_unknown_pixels_are_not_proposed() -> None:
    unknown = AppearedPixels(torch.full((2, 30, 40), torch.nan, dtype=torch.float64), STRIDE)
    nothing = AppearedPixels(torch.zeros(0, 30, 40, dtype=torch.float64), STRIDE)
    for proposed in (propose(unknown), propose(nothing), propose(appeared_in())):
        assert len(proposed) == 0
        assert proposed.masks.shape == (0, 120, 160) and proposed.boxes.shape == (0, 4)


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0, 5.0])
def test_min_area_is_in_square_metres(z: float) -> None:
    """The region has 40 x 40 pixels at depth z."""
    area = (40 * z / CAMERA.fx) * (40 * z / CAMERA.fy)
    assert len(propose(appeared_in(REGION), z=z, min_area=0.999 * area)) == 1
    assert len(propose(appeared_in(REGION), z=z, min_area=1.001 * area)) == 0


def test_small_region_is_removed_and_large_region_kept() -> None:
    """The small region comes first in the image: indices must not shift."""
    small = slice(0, 4), slice(0, 4)
    proposed = propose(appeared_in(small, REGION), min_area=0.1)
    assert torch.equal(proposed.masks, MASK[None])


@pytest.mark.parametrize(("side", "stays"), [(1, False), (2, False), (3, True)])
def test_specks_are_removed(side: int, stays: bool) -> None:
    speck = slice(12, 12 + side), slice(17, 17 + side)
    assert len(propose(appeared_in(speck), min_area=1e-9)) == stays


def test_region_covered_by_an_instance_is_not_proposed() -> None:
    assert len(propose(appeared_in(REGION), person(MASK))) == 0
    elsewhere = rectangle(slice(0, 40), slice(0, 40))
    assert torch.equal(propose(appeared_in(REGION), person(elsewhere)).masks, MASK[None])


@pytest.mark.parametrize(("columns", "stays"), [(slice(60, 136), False), (slice(60, 144), True)])
def test_region_in_a_thing_is_proposed_unless_most_of_the_thing_appeared(columns: slice, stays: bool) -> None:
    """The region fills 40 columns of a table that stands still or moves; a mask of a person covers it in any case."""
    mask = rectangle(slice(40, 80), columns)
    assert bool(len(propose(appeared_in(REGION), instance(mask, COCO_NAMES.index("dining table"))))) is stays
    assert len(propose(appeared_in(REGION), person(mask))) == 0


def test_uncovered_part_of_a_region_is_proposed() -> None:
    """An instance covers the left half, and two cells beside it are its rim: the others remain."""
    labelled = person(rectangle(slice(40, 80), slice(60, 80)))
    proposed = propose(appeared_in(REGION), labelled)
    assert torch.equal(proposed.masks, rectangle(slice(40, 80), slice(88, 100))[None])


@pytest.mark.parametrize(("cut", "stays"), [(8, False), (12, True)])
def test_rim_of_an_instance_is_not_proposed(cut: int, stays: bool) -> None:
    """The mask is too small on all sides; the remaining rim of a walker is no object."""
    labelled = person(rectangle(slice(40 + cut, 80 - cut), slice(60 + cut, 100 - cut)))
    assert bool(len(propose(appeared_in(REGION), labelled, min_area=1e-9))) is stays


def test_masks_have_the_image_size_if_the_stride_does_not_divide_it() -> None:
    camera = PinholeCamera(fx=131.25, fy=120.0, cx=79.5, cy=59.5, width=158, height=117)
    proposed = propose(
        appeared_in((slice(20, 30), slice(30, 40))), Instances.empty(117, 158), min_area=1e-9, camera=camera
    )
    assert proposed.masks.shape == (1, 117, 158)
    assert proposed.masks[0, 80:, 120:].all() and proposed.masks.sum() == 37 * 38


def test_box_carried_into_the_room_is_proposed() -> None:
    """From depth images: the box has appeared and becomes one instance, which is not proposed again."""
    check = FreeSpaceCheck(FreeSpaceConfig(), CAMERA)
    here = torch.eye(4, dtype=torch.float64)
    wall = torch.full((1, 120, 160), 4.0)
    check.add_view(DepthView(0.0, wall, here), here)
    depth = torch.where(MASK, 2.0, wall)
    appeared = check(DepthView(0.3, depth, here))
    proposed = unlabelled_instances(appeared, NO_INSTANCES, depth, CAMERA, FreeSpaceConfig().min_unlabelled_area)
    assert torch.equal(proposed.masks, MASK[None])
    assert len(unlabelled_instances(appeared, proposed, depth, CAMERA, FreeSpaceConfig().min_unlabelled_area)) == 0


def test_labelled_and_unlabelled_instances_are_concatenated_in_order() -> None:
    labelled, unlabelled = person(rectangle(slice(0, 40), slice(0, 40))), propose(appeared_in(REGION))
    joined = labelled.concatenate(unlabelled)
    assert joined.labels.tolist() == [PERSON, UNLABELLED]
    for field in ("masks", "labels", "scores", "boxes"):
        one, first, second = (getattr(instances, field) for instances in (joined, labelled, unlabelled))
        assert torch.equal(one[:1], first) and torch.equal(one[1:], second) and one.dtype == first.dtype
    assert len(NO_INSTANCES.concatenate(unlabelled)) == len(unlabelled.concatenate(NO_INSTANCES)) == 1
    assert len(NO_INSTANCES.concatenate(NO_INSTANCES)) == 0


def test_ids_of_propagated_instances_stay_with_them() -> None:
    propagated = replace(person(rectangle(slice(0, 40), slice(0, 40))), track_ids=torch.tensor([7]))
    unlabelled = propose(appeared_in(REGION))
    assert unlabelled.track_ids is None and unlabelled.concatenate(unlabelled).track_ids is None
    for joined, expected in (
        (propagated.concatenate(unlabelled), [7, 0]),
        (unlabelled.concatenate(propagated), [0, 7]),
    ):
        assert joined.track_ids is not None and joined.track_ids.tolist() == expected
        last = joined[torch.tensor([False, True])].track_ids
        assert last is not None and last.tolist() == expected[1:]


def test_class_names_include_unlabelled() -> None:
    assert [class_name(label) for label in range(80)] == list(COCO_NAMES)
    assert class_name(PERSON) == "person"
    assert class_name(UNLABELLED) == "unlabelled" and "unlabelled" not in COCO_NAMES
