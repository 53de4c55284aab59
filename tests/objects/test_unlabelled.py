"""What moves and has no name: regions that came become instances, unless they are small, or somebody's rim."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.free_space_check import DepthView, FreeSpaceCheck, NewlyOccupied
from v3d_torch.objects.unlabelled import unlabelled_instances
from v3d_torch.segmentation.coco import COCO_NAMES, PERSON, UNLABELLED, class_name
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=131.25, fy=120.0, cx=79.5, cy=59.5, width=160, height=120)
NOBODY = Instances.empty(120, 160)
STRIDE = 4


def arrivals(*regions: tuple[slice, slice], baselines: int = 2, height: int = 30, width: int = 40) -> NewlyOccupied:
    """Rows and columns that came over the last baseline; over the others nothing is known, around them nothing came."""
    came = torch.zeros(baselines, height, width, dtype=torch.float64)
    came[:-1] = torch.nan
    for rows, columns in regions:
        came[-1, rows, columns] = 1.0
    return NewlyOccupied(came, STRIDE)


def propose(
    found: NewlyOccupied,
    named: Instances = NOBODY,
    z: float = 2.0,
    min_area: float = 0.02,
    camera: PinholeCamera = CAMERA,
) -> Instances:
    return unlabelled_instances(found, named, torch.full((1, camera.height, camera.width), z), camera, min_area)


def rectangle(rows: slice, columns: slice) -> Tensor:
    mask = torch.zeros(120, 160, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


def person(mask: Tensor) -> Instances:
    return Instances(mask[None], torch.tensor([PERSON]), torch.tensor([0.9]), torch.tensor([[60.0, 40.0, 100.0, 80.0]]))


REGION = slice(10, 20), slice(15, 25)  # of the arrivals
MASK = rectangle(slice(40, 80), slice(60, 100))  # the same pixels of the image


def test_a_region_that_came_is_an_instance_without_a_name() -> None:
    found = propose(arrivals(REGION))
    assert torch.equal(found.masks, MASK[None]) and found.masks.dtype == torch.bool
    assert found.labels.tolist() == [UNLABELLED] and found.labels.dtype == torch.int64
    assert found.scores.tolist() == [0.0] and found.scores.dtype == torch.float32
    assert found.boxes.tolist() == [[0.0] * 4] and found.boxes.dtype == torch.float32


def test_regions_apart_are_instances_apart() -> None:
    regions = [REGION, (slice(0, 5), slice(0, 6)), (slice(22, 30), slice(30, 40))]
    found = propose(arrivals(*regions))
    assert len(found) == 3
    assert (found.masks.sum(dim=0) <= 1).all()
    assert {int(mask.sum()) for mask in found.masks} == {1600, 16 * 30, 16 * 80}


@pytest.mark.parametrize("baselines", [1, 2, 3])
def test_any_baseline_suffices(baselines: int) -> None:
    assert len(propose(arrivals(REGION, baselines=baselines))) == 1


def test_what_cannot_be_told_has_not_come() -> None:
    unknown = NewlyOccupied(torch.full((2, 30, 40), torch.nan, dtype=torch.float64), STRIDE)
    nothing = NewlyOccupied(torch.zeros(0, 30, 40, dtype=torch.float64), STRIDE)
    for found in (propose(unknown), propose(nothing), propose(arrivals())):
        assert len(found) == 0
        assert found.masks.shape == (0, 120, 160) and found.boxes.shape == (0, 4)


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0, 5.0])
def test_least_area_is_in_square_metres(z: float) -> None:
    """40 x 40 pixels at depth z."""
    area = (40 * z / CAMERA.fx) * (40 * z / CAMERA.fy)
    assert len(propose(arrivals(REGION), z=z, min_area=0.999 * area)) == 1
    assert len(propose(arrivals(REGION), z=z, min_area=1.001 * area)) == 0


def test_the_small_are_left_out_and_the_large_stay_themselves() -> None:
    """The small one comes first in the image: numbers must not shift."""
    small = slice(0, 4), slice(0, 4)
    found = propose(arrivals(small, REGION), min_area=0.1)
    assert torch.equal(found.masks, MASK[None])


@pytest.mark.parametrize(("side", "stays"), [(1, False), (2, False), (3, True)])
def test_specks_are_noise_of_the_depth(side: int, stays: bool) -> None:
    speck = slice(12, 12 + side), slice(17, 17 + side)
    assert len(propose(arrivals(speck), min_area=1e-9)) == stays


def test_what_a_named_instance_covers_is_left_to_it() -> None:
    assert len(propose(arrivals(REGION), person(MASK))) == 0
    elsewhere = rectangle(slice(0, 40), slice(0, 40))
    assert torch.equal(propose(arrivals(REGION), person(elsewhere)).masks, MASK[None])


def test_a_region_with_people_in_it_keeps_the_rest() -> None:
    """The left half is named, two cells beside it are its rim: the others stay."""
    named = person(rectangle(slice(40, 80), slice(60, 80)))
    found = propose(arrivals(REGION), named)
    assert torch.equal(found.masks, rectangle(slice(40, 80), slice(88, 100))[None])


@pytest.mark.parametrize(("cut", "stays"), [(8, False), (12, True)])
def test_the_rim_of_a_named_instance_is_not_proposed(cut: int, stays: bool) -> None:
    """The mask is too small all around; what it leaves of a walker that came is no object of its own."""
    named = person(rectangle(slice(40 + cut, 80 - cut), slice(60 + cut, 100 - cut)))
    assert bool(len(propose(arrivals(REGION), named, min_area=1e-9))) is stays


def test_masks_have_the_size_of_an_image_that_the_stride_does_not_divide() -> None:
    camera = PinholeCamera(fx=131.25, fy=120.0, cx=79.5, cy=59.5, width=158, height=117)
    found = propose(arrivals((slice(20, 30), slice(30, 40))), Instances.empty(117, 158), min_area=1e-9, camera=camera)
    assert found.masks.shape == (1, 117, 158)
    assert found.masks[0, 80:, 120:].all() and found.masks.sum() == 37 * 38


def test_a_box_carried_into_the_room_is_proposed() -> None:
    """From depth on: the watch tells what came, and of it an instance is made, which no second one covers."""
    watch = FreeSpaceCheck(FreeSpaceConfig(), CAMERA)
    here = torch.eye(4, dtype=torch.float64)
    wall = torch.full((1, 120, 160), 4.0)
    watch.remember(DepthView(0.0, wall, here))
    depth = torch.where(MASK, 2.0, wall)
    came = watch(DepthView(0.3, depth, here))
    found = unlabelled_instances(came, NOBODY, depth, CAMERA, FreeSpaceConfig().min_unlabelled_area)
    assert torch.equal(found.masks, MASK[None])
    assert len(unlabelled_instances(came, found, depth, CAMERA, FreeSpaceConfig().min_unlabelled_area)) == 0


def test_named_and_unnamed_are_joined_in_this_order() -> None:
    named, unnamed = person(rectangle(slice(0, 40), slice(0, 40))), propose(arrivals(REGION))
    joined = named.concatenate(unnamed)
    assert joined.labels.tolist() == [PERSON, UNLABELLED]
    for field in ("masks", "labels", "scores", "boxes"):
        one, first, second = (getattr(instances, field) for instances in (joined, named, unnamed))
        assert torch.equal(one[:1], first) and torch.equal(one[1:], second) and one.dtype == first.dtype
    assert len(NOBODY.concatenate(unnamed)) == len(unnamed.concatenate(NOBODY)) == 1
    assert len(NOBODY.concatenate(NOBODY)) == 0


def test_each_class_has_a_name_and_so_has_none() -> None:
    assert [class_name(label) for label in range(80)] == list(COCO_NAMES)
    assert class_name(PERSON) == "person"
    assert class_name(UNLABELLED) == "unnamed" and "unnamed" not in COCO_NAMES
