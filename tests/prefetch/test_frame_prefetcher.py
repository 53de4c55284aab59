"""The next frame is looked at while one is tracked: it makes no difference to what comes out."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing

import pytest
import torch

from v3d_torch import V3DSLAM, RGBDFrame, load_sequence
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.errors import InputError
from v3d_torch.frame_result import PreprocessedFrame
from v3d_torch.pipeline import Pipeline
from v3d_torch.prefetch.frame_prefetcher import FramePrefetcher
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import PREFETCHED_FRAMES
from v3d_torch.types import Instances

NO_NETWORK = load_config(None, ("segmentation.source=none",))
FRAMES = 5


@pytest.fixture(scope="module")
def demo() -> RGBDSequence:
    return load_sequence("demo")


class Expecting:
    """A segmenter that sees nothing, and notes where it was told that each frame is and in which thread."""

    def __init__(self) -> None:
        self.poses: list[torch.Tensor | None] = []
        self.threads: set[str] = set()

    def __call__(self, frame: RGBDFrame) -> Instances:
        raise AssertionError("called without a pose")

    def segment_with_pose(self, frame: RGBDFrame, T_cw: torch.Tensor | None) -> Instances:
        self.poses.append(T_cw)
        self.threads.add(threading.current_thread().name)
        return NoSegmentation()(frame)


def run(demo: RGBDSequence, *, ahead: bool) -> tuple[V3DSLAM, Expecting]:
    seen = Expecting()
    slam = V3DSLAM(demo.camera, seen, NO_NETWORK)
    with closing(FramePrefetcher((demo[index] for index in range(FRAMES)), slam, ahead=ahead)) as percepts:
        for percept in percepts:
            slam.track(percept)
    return slam, seen


def test_ahead_one_by_one_and_called_by_hand_are_the_same_to_the_bit(demo: RGBDSequence) -> None:
    by_hand = Expecting()
    called = V3DSLAM(demo.camera, by_hand, NO_NETWORK)
    for index in range(FRAMES):
        called(demo[index])
    for ahead in (False, True):
        slam, seen = run(demo, ahead=ahead)
        assert torch.equal(slam.poses.trajectory().T_wc, called.poses.trajectory().T_wc)
        for told, expected in zip(seen.poses, by_hand.poses, strict=True):
            assert told is not None and expected is not None and torch.equal(told, expected)


def test_only_ahead_is_another_thread_at_work(demo: RGBDSequence) -> None:
    here = threading.current_thread().name
    assert run(demo, ahead=False)[1].threads == {here}
    others = run(demo, ahead=True)[1].threads
    assert len(others) == 1 and here not in others
    assert not others & {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize("ahead", [False, True])
def test_so_many_frames_are_read_ahead_and_no_more(demo: RGBDSequence, ahead: bool) -> None:
    read: list[int] = []

    def frames() -> Iterator[RGBDFrame]:
        for index in range(FRAMES):
            read.append(index)
            yield demo[index]

    slam = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    with closing(FramePrefetcher(frames(), slam, ahead=ahead)) as percepts:
        for taken, percept in enumerate(percepts):
            slam.track(percept)
            assert percept.frame.index == taken
            assert len(read) <= taken + 1 + ahead * PREFETCHED_FRAMES
            assert set(percept.seconds) == {"read", "segmentation", "depth", "features"}
    assert read == list(range(FRAMES))


@pytest.mark.parametrize("ahead", [False, True])
def test_a_broken_frame_is_told_of_after_those_before_it(demo: RGBDSequence, ahead: bool) -> None:
    def frames() -> Iterator[RGBDFrame]:
        yield from (demo[0], demo[1])
        raise InputError("depth/2.png: is truncated")

    slam = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    given: list[PreprocessedFrame] = []
    with (
        pytest.raises(InputError, match="truncated"),
        closing(FramePrefetcher(frames(), slam, ahead=ahead)) as percepts,
    ):
        for percept in percepts:
            slam.track(percept)
            given.append(percept)
    assert [percept.frame.index for percept in given] == [0, 1]


def test_who_stops_early_leaves_no_thread_behind(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    before = set(threading.enumerate())
    percepts = FramePrefetcher((demo[index] for index in range(FRAMES)), slam, ahead=True)
    next(iter(percepts))
    (thread,) = set(threading.enumerate()) - before
    percepts.close()
    assert not thread.is_alive()


def test_a_pipeline_does_as_its_configuration_says(demo: RGBDSequence) -> None:
    class Short:
        camera, name, groundtruth = demo.camera, "short", None

        def __iter__(self) -> Iterator[RGBDFrame]:
            return (demo[index] for index in range(3))

    for lookahead in (False, True):
        seen = Expecting()
        config = NO_NETWORK.model_copy(update={"lookahead": lookahead})
        Pipeline(Short(), V3DSLAM(demo.camera, seen, config))()
        assert (threading.current_thread().name in seen.threads) is not lookahead
