"""The right way up: found by what a network sees in the turns of an image, kept by the camera's poses."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.types import Instances, RGBDFrame

HEIGHT, WIDTH = 24, 32


def rolled(degrees: float) -> Tensor:
    """World to a camera that is turned clockwise about its optical axis, as seen from behind it."""
    twist = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, math.radians(degrees)], dtype=torch.float64)
    return invert(se3_exp(twist))


def frame(index: int, turns_needed: int | None, T_cw: Tensor | None) -> RGBDFrame:
    """An image that so many counterclockwise quarter turns set upright: its upper edge is bright; None: all dark."""
    portrait = (turns_needed or 0) % 2 == 1
    image = torch.zeros(3, WIDTH, HEIGHT, dtype=torch.uint8) if portrait else torch.zeros(3, HEIGHT, WIDTH).byte()
    if turns_needed is not None:
        image[:, :2, : image.shape[2]] = 255
        image = torch.rot90(image, -turns_needed, dims=(1, 2)).contiguous()
    assert image.shape == (3, HEIGHT, WIDTH)
    return RGBDFrame(index, index / 30, image, torch.ones(1, HEIGHT, WIDTH), T_cw)


class Network:
    """Sees a thing in the upper left corner of an image whose upper edge is bright, in others a doubtful one."""

    def __init__(self, sure: float = 0.9, doubtful: float = 0.3) -> None:
        self.sizes: list[tuple[int, int]] = []
        self._scores = sure, doubtful

    def __call__(self, frame: RGBDFrame) -> Instances:
        height, width = frame.image.shape[1:]
        assert frame.depth.shape == (1, height, width)
        self.sizes.append((height, width))
        masks = torch.zeros(1, height, width, dtype=torch.bool)
        masks[0, 2:5, 3:9] = True
        upright = bool((frame.image[:, 0] == 255).all())
        score = self._scores[0] if upright else self._scores[1]
        return Instances(masks, torch.tensor([int(not upright)]), torch.tensor([score]), torch.tensor([[3.0, 2, 9, 5]]))


@pytest.mark.parametrize("turns", range(4))
def test_an_image_is_seen_upright_and_its_instances_lie_where_they_are(turns: int) -> None:
    """Whichever way the camera is held from the first frame on; boxes and masks are those of the image as it is."""
    network = Network()
    seen = UprightSegmenter(network)(frame(0, turns, torch.eye(4, dtype=torch.float64)))
    assert seen.labels.tolist() == [0] and seen.masks.shape == (1, HEIGHT, WIDTH)
    shape = (HEIGHT, WIDTH) if turns % 2 == 0 else (WIDTH, HEIGHT)
    there = torch.zeros(shape, dtype=torch.bool)
    there[2:5, 3:9] = True
    assert torch.equal(seen.masks[0], torch.rot90(there, -turns, dims=(0, 1)))
    rows, columns = torch.nonzero(seen.masks[0], as_tuple=True)
    edges = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    assert seen.boxes.tolist() == [[float(edge) for edge in edges]]


@pytest.mark.parametrize("start", [0, 1, 2, 3])
def test_the_poses_carry_up_along_as_the_camera_rolls(start: int) -> None:
    """After the first looks one turn of each image is enough, also as the camera rolls on through all four."""
    network = Network(sure=1.0, doubtful=0.0)
    upright = UprightSegmenter(network)
    for index in range(16):
        upright(frame(index, start, torch.eye(4, dtype=torch.float64)))
    # A camera that rolls clockwise sees the world turn counterclockwise: up moves to its left, its upper right is up.
    for index, degrees in enumerate((3 * 90, 180, 90, 0, -90, 350, -350)):
        before = len(network.sizes)
        needed = (start - round(degrees / 90)) % 4
        seen = upright(frame(16 + index, needed, rolled(degrees)))
        assert seen.labels.tolist() == [0], degrees
        looks = 4 if 16 + index == 16 else 1
        assert len(network.sizes) - before == looks


def test_a_look_at_all_turns_becomes_rare() -> None:
    network = Network(sure=1.0, doubtful=0.0)
    upright = UprightSegmenter(network)
    for index in range(300):
        upright(frame(index, 0, torch.eye(4, dtype=torch.float64)))
    # At each 8th call until ten sure votes, and at the powers of two.
    assert len(network.sizes) == 300 + 3 * len({0, 1, 2, 4, 8, 16, 24, 32, 40, 48, 64, 128, 256})


def test_where_nothing_is_seen_images_are_shown_as_they_are() -> None:
    network = Network(doubtful=0.0)
    upright = UprightSegmenter(network)
    for index in range(300):
        upright(frame(index, None, torch.eye(4, dtype=torch.float64)))
    assert upright(frame(300, None, torch.eye(4, dtype=torch.float64))).masks[0, 2:5, 3:9].all()
    # Without a vote it looks around at every 8th of the first 128 calls, and no more often than that.
    assert len(network.sizes) == 301 + 3 * (16 + len({1, 2, 4, 128, 256}))


def test_one_wrong_vote_is_outvoted() -> None:
    """A picture on the wall shows people lying: two later looks put it right."""
    upright = UprightSegmenter(Network(sure=0.9, doubtful=0.0))
    here = torch.eye(4, dtype=torch.float64)
    upright(frame(0, 1, here))
    for index in range(1, 9):
        seen = upright(frame(index, 0, here))
    assert seen.labels.tolist() == [0]


def test_a_frame_whose_pose_nobody_knows_is_shown_as_it_is() -> None:
    network = Network()
    assert UprightSegmenter(network)(frame(0, 1, None)).labels.tolist() == [1]
    assert network.sizes == [(HEIGHT, WIDTH)]
