"""Upright segmentation: search for the up direction, use of the camera's poses, saved state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.tilted_frames import HEIGHT, IDENTITY, WIDTH, Network, make_frame
from torch import Tensor

from v3d_torch.errors import ConfigError
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.types import Instances, RGBDFrame


def rolled(degrees: float) -> Tensor:
    """World-to-camera pose of a camera rolled clockwise about its optical axis, as seen from behind the camera."""
    twist = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, math.radians(degrees)], dtype=torch.float64)
    return invert(se3_exp(twist))


@pytest.mark.parametrize("turns", range(4))
def test_instances_are_in_the_orientation_of_the_frame(turns: int) -> None:
    """At any orientation of the first frame, the network segments it upright, and masks and boxes are rotated back."""
    instances = UprightSegmenter(Network()).segment_with_pose(make_frame(0, turns), IDENTITY)
    assert instances.labels.tolist() == [0] and instances.masks.shape == (1, HEIGHT, WIDTH)
    shape = (HEIGHT, WIDTH) if turns % 2 == 0 else (WIDTH, HEIGHT)
    upright_mask = torch.zeros(shape, dtype=torch.bool)
    upright_mask[2:5, 3:9] = True
    assert torch.equal(instances.masks[0], torch.rot90(upright_mask, -turns, dims=(0, 1)))
    rows, columns = torch.nonzero(instances.masks[0], as_tuple=True)
    edges = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    assert instances.boxes.tolist() == [[float(edge) for edge in edges]]


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, "the segmenter returned a NoneType for frame 3; it must return Instances"),
        (Instances.empty(HEIGHT + 1, WIDTH), r"masks for frame 3 are torch.bool of shape \(0, 25, 32\)"),
        (
            replace(Network()(make_frame(3, 0)), scores=torch.tensor([torch.nan])),
            "scores for frame 3 have values that are not from 0 to 1",
        ),
    ],
)
def test_invalid_instances_of_the_wrapped_segmenter_are_rejected(returned: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        UprightSegmenter(lambda _: returned).segment_with_pose(make_frame(3, 0), IDENTITY)


@pytest.mark.parametrize("start", [0, 1, 2, 3])
def test_poses_give_the_up_direction_of_a_rolling_camera(start: int) -> None:
    """After the first searches one turn of each image is enough, also if the camera rolls through all four."""
    network = Network(confident=1.0, doubtful=0.0)
    upright = UprightSegmenter(network)
    for index in range(16):
        upright.segment_with_pose(make_frame(index, start), IDENTITY)
    # In the image of a camera that rolls clockwise, the world turns counterclockwise.
    for index, degrees in enumerate((3 * 90, 180, 90, 0, -90, 350, -350)):
        before = len(network.sizes)
        upright_turns = (start - round(degrees / 90)) % 4
        instances = upright.segment_with_pose(make_frame(16 + index, upright_turns), rolled(degrees))
        assert instances.labels.tolist() == [0], degrees
        calls = 2 if 16 + index in {17, 18, 19} else 1
        assert len(network.sizes) - before == calls


def test_searches_become_rare_when_up_is_settled() -> None:
    network = Network(confident=1.0, doubtful=0.0)
    upright = UprightSegmenter(network)
    for index in range(300):
        upright.segment_with_pose(make_frame(index, 0), IDENTITY)
    # The first call segments all turns. Later searches start at every 8th call until the votes have a weight of ten,
    # during the one that starts at 56, and at powers of two.
    assert len(network.sizes) == 300 + 3 + 3 * len({0, 4, 8, 16, 24, 32, 40, 48, 64, 128, 256}) + 2


def test_no_call_after_the_first_segments_more_than_two_turns() -> None:
    """A live camera does not wait for four images at once."""
    network = Network(confident=0.1, doubtful=0.1)
    upright = UprightSegmenter(network)
    for index in range(100):
        before = len(network.sizes)
        upright.segment_with_pose(make_frame(index, 1), IDENTITY)
        assert len(network.sizes) - before <= (4 if index == 0 else 2)


def test_turns_of_equal_scores_do_not_change_the_up_direction() -> None:
    """In a search over three images each turn has the same weight, although the upright one is segmented each time."""
    upright = UprightSegmenter(Network(confident=0.5, doubtful=0.5))
    for index in range(8):
        upright.segment_with_pose(make_frame(index, None), rolled(20.0))
    assert torch.allclose(upright.state_dict()["up"], torch.tensor([0.0, -0.5, 0.0], dtype=torch.float64))


def test_without_detections_frames_keep_their_orientation_and_searches_are_bounded() -> None:
    network = Network(doubtful=0.0)
    upright = UprightSegmenter(network)
    for index in range(300):
        upright.segment_with_pose(make_frame(index, None), IDENTITY)
    assert upright.segment_with_pose(make_frame(300, None), IDENTITY).masks[0, 2:5, 3:9].all()
    # Without a vote: all turns in the first call, and searches at every 8th of the first 128 and at powers of two.
    assert len(network.sizes) == 301 + 3 + 3 * (16 + len({4, 128, 256}))


def test_later_votes_outweigh_a_wrong_one() -> None:
    """The first image shows a picture of lying people: two later searches correct the up direction."""
    upright = UprightSegmenter(Network(confident=0.9, doubtful=0.0))
    upright.segment_with_pose(make_frame(0, 1), IDENTITY)
    for index in range(1, 9):
        instances = upright.segment_with_pose(make_frame(index, 0), IDENTITY)
    assert instances.labels.tolist() == [0]


def test_frame_without_a_pose_keeps_its_orientation_and_gives_no_vote() -> None:
    network = Network()
    upright = UprightSegmenter(network)
    before = upright.state_dict()
    assert upright.segment_with_pose(make_frame(0, 1), None).labels.tolist() == [1]
    assert upright(make_frame(0, 1)).labels.tolist() == [1]
    assert network.sizes == [(HEIGHT, WIDTH)] * 2
    assert upright.state_dict()["calls"] == before["calls"] == 0
    assert torch.equal(upright.state_dict()["up"], before["up"])


@pytest.mark.parametrize("start", range(4))
def test_measured_gravity_gives_the_up_direction_from_the_first_frame_on(start: int) -> None:
    """No frame needs a search, also if the network never detects anything upright, and if the camera rolls later."""
    network = Network(confident=0.9, doubtful=0.9)
    upright = UprightSegmenter(network)
    angle = math.radians(90 * start + 20)  # 20 degrees off a quarter turn
    gravity = -torch.tensor([math.sin(angle), -math.cos(angle), 0.0], dtype=torch.float64)
    first = replace(make_frame(0, start), gravity=gravity)
    assert upright(first).labels.tolist() == [0]  # without a pose
    assert upright.segment_with_pose(first, IDENTITY).labels.tolist() == [0]
    for index, degrees in enumerate((0, 90, 180), start=1):
        frame = make_frame(index, (start - round(degrees / 90)) % 4)
        assert upright.segment_with_pose(frame, rolled(degrees)).labels.tolist() == [0]
    assert len(network.sizes) == 5


@pytest.mark.parametrize("seed", range(3))
def test_gravity_in_any_orientation_of_the_camera_gives_the_up_direction_of_the_world(seed: int) -> None:
    twist, up = 2 * torch.randn(2, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    T_cw, up = se3_exp(twist), torch.nn.functional.normalize(up[:3], dim=0)
    upright = UprightSegmenter(Network())
    upright.segment_with_pose(replace(make_frame(0, 0), gravity=-T_cw[:3, :3] @ up), T_cw)
    torch.testing.assert_close(upright.up_votes / upright.up_votes.norm(), up)


@pytest.mark.parametrize("turns", range(4))
def test_searches_of_a_rolled_camera_vote_for_the_up_direction_of_the_world(turns: int) -> None:
    upright = UprightSegmenter(Network(confident=1.0, doubtful=0.0))
    for index in range(8):  # three searches, each with a vote of weight 1 for the upright turn
        upright.segment_with_pose(make_frame(index, turns), rolled(-90.0 * turns))
    expected = torch.tensor([0.0, -3.5, 0.0], dtype=torch.float64)  # with the prior
    torch.testing.assert_close(upright.up_votes, expected)


def test_frames_with_gravity_are_never_searched() -> None:
    network = Network(doubtful=0.0)
    upright, gravity = UprightSegmenter(network), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    for index in range(300):
        upright.segment_with_pose(replace(make_frame(index, 0), gravity=gravity), IDENTITY)
    assert len(network.sizes) == 300


def test_segmenter_that_loads_a_state_continues_with_the_same_results() -> None:
    first, second = Network(), Network()
    upright, loaded = UprightSegmenter(first), UprightSegmenter(second)
    for index in range(9):
        upright.segment_with_pose(make_frame(index, 1), IDENTITY)
    loaded.load_state_dict(upright.state_dict())
    first.sizes.clear()
    for index in range(9, 40):
        frame, T_cw = make_frame(index, (1 - index) % 4), rolled(90.0 * index)
        expected, instances = upright.segment_with_pose(frame, T_cw), loaded.segment_with_pose(frame, T_cw)
        assert torch.equal(instances.masks, expected.masks) and torch.equal(instances.labels, expected.labels)
    assert second.sizes == first.sizes
    assert torch.equal(loaded.state_dict()["up"], upright.state_dict()["up"])


def test_state_is_a_snapshot() -> None:
    upright = UprightSegmenter(Network())
    state = upright.state_dict()
    calls, up = state["calls"], state["up"].clone()
    upright.segment_with_pose(make_frame(0, 0), IDENTITY)
    assert (state["calls"], calls) == (0, 0) and torch.equal(state["up"], up)
    assert not torch.equal(upright.state_dict()["up"], up)
    state["up"].zero_()
    upright.load_state_dict({"calls": 3, "up": up})
    up.zero_()
    assert upright.state_dict()["up"].norm() > 0


def test_votes_of_a_call_do_not_change_those_of_the_call_before() -> None:
    upright = UprightSegmenter(Network())
    before = upright.up_votes
    expected = before.clone()
    upright.segment_with_pose(make_frame(0, 1), IDENTITY)
    votes = upright.up_votes
    assert torch.equal(before, expected) and votes.norm() > 0.5 and votes[0].abs() > votes[1].abs()


def test_state_contains_that_of_the_segmenter_inside() -> None:
    class Counter(Network):
        calls = 0

        def __call__(self, frame: RGBDFrame) -> Instances:
            self.calls += 1
            return super().__call__(frame)

        def state_dict(self) -> dict[str, int]:
            return {"calls": self.calls}

        def load_state_dict(self, state: Mapping[str, int]) -> None:
            self.calls = state["calls"]

    upright, loaded = UprightSegmenter(Counter()), UprightSegmenter(Counter())
    for index in range(3):
        upright.segment_with_pose(make_frame(index, 0), IDENTITY)
    loaded.load_state_dict(upright.state_dict())
    assert isinstance(loaded.wrapped, Counter) and isinstance(upright.wrapped, Counter)
    assert loaded.wrapped.calls == upright.wrapped.calls > 3
