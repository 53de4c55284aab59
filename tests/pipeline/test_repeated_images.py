"""Images that repeat the one before: counted, and warned of if they are many or all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from helpers.short_wall import CAMERA, FRAMES, WALL, Wall, square
from torch import Tensor

from v3d_torch.pipeline import Pipeline
from v3d_torch.pipeline.repeated_images import RepeatedImages
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame


def picture(seed: int) -> Tensor:
    return torch.randint(0, 255, (3, 48, 64), generator=torch.Generator().manual_seed(seed)).to(torch.uint8)


@pytest.mark.parametrize(
    ("numbers", "count", "is_warned_of"),
    [
        (range(40), 0, False),
        ([*range(20), *range(18, 38)], 0, False),  # an image that returns is no repetition
        ([0, 0, *range(1, 39)], 1, False),
        ([number // 2 for number in range(40)], 20, True),
        ([*[0] * 9, *range(1, 32)], 8, True),
    ],
)
def test_many_repeated_images_are_warned_of(numbers: list[int], count: int, is_warned_of: bool) -> None:
    repeated = RepeatedImages()
    for number in numbers:
        repeated.add(picture(number))
    assert repeated.count == count
    warnings = repeated.check(len(numbers))
    assert [warning.startswith(f"{count} of {len(numbers)} images are equal") for warning in warnings] == (
        [True] * is_warned_of
    )


@pytest.mark.parametrize(
    ("numbers", "equal"),
    [
        ([0] * 2, 0),
        ([0] * 9, 0),
        ([0] * 10, 10),
        ([0] * 40, 40),
        ([*range(20), *[20] * 20], 20),
        ([*[0] * 10, *range(1, 20), *[20] * 11], 11),
    ],
)
def test_a_stream_that_shows_one_image_is_stuck(numbers: list[int], equal: int) -> None:
    """Also a camera that stands still has noise, and a few frames can be a test."""
    repeated = RepeatedImages()
    for number in numbers:
        repeated.add(picture(number))
    text = f"{equal} of {len(numbers)} images in a row are equal: the stream seems to be stuck"
    assert [warning.startswith(text) for warning in repeated.check(len(numbers))] == [True] * (equal > 0)


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (10, 20, 30)])
def test_uniform_images_are_no_repetition(colour: tuple[int, int, int]) -> None:
    """Images in the dark are equal, but nobody copied them."""
    repeated = RepeatedImages()
    repeated.add(picture(0))
    for _ in range(39):
        repeated.add(torch.tensor(colour, dtype=torch.uint8)[:, None, None].expand(3, 48, 64))
    assert repeated.count == 0 and repeated.check(40) == []


def test_one_pixel_makes_another_image() -> None:
    repeated = RepeatedImages()
    image = picture(0)
    repeated.add(image)
    changed = image.clone()
    changed[1, 5, 7] ^= 1
    repeated.add(changed)
    assert repeated.count == 0


class Stutter:
    """Each frame along the wall twice, with a stamp of its own."""

    name, camera, groundtruth = "stutter", CAMERA, None

    def __iter__(self) -> Iterator[RGBDFrame]:
        wall = Wall()
        for index in range(2 * FRAMES):
            yield replace(wall[index // 2], index=index, stamp=index / 20)


def test_run_with_repeated_images_has_a_warning() -> None:
    pipeline = Pipeline(Stutter(), V3DSLAM(CAMERA, square))
    pipeline()
    pipeline.flush()
    assert any(f"{FRAMES} of {2 * FRAMES} images are equal" in warning for warning in pipeline.record.warnings)


class StuckDepth(Wall):
    """The wall with a depth camera that delivers its first image, with noise, again and again."""

    noise = WALL + 0.01 * torch.rand(1, 240, 320, generator=torch.Generator().manual_seed(0))

    def __getitem__(self, index: int) -> RGBDFrame:
        return replace(super().__getitem__(index), depth=self.noise.clone())


@pytest.mark.parametrize(("sequence", "is_warned_of"), [(StuckDepth(), True), (Wall(), False)])
def test_run_with_one_depth_image_has_a_warning(sequence: Wall, is_warned_of: bool) -> None:
    pipeline = Pipeline(sequence, V3DSLAM(CAMERA, square))
    pipeline()
    pipeline.flush()
    text = f"{FRAMES} of {FRAMES} depth images in a row are equal: the stream seems to be stuck"
    assert any(text in warning for warning in pipeline.record.warnings) == is_warned_of
