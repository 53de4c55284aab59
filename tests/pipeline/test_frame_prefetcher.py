"""Prefetching preprocesses the next frames while one is tracked, and does not change the results."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing

import pytest
import torch
from helpers.first_frames import FirstFrames

from v3d_torch import V3DSLAM, RGBDFrame
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.errors import InputError
from v3d_torch.frame_result import PreprocessedFrame
from v3d_torch.pipeline import Pipeline
from v3d_torch.pipeline.frame_prefetcher import FramePrefetcher
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.stages.frame_preprocessor import PREFETCHED_FRAMES
from v3d_torch.types import Instances

NO_NETWORK = load_config(None, ("segmentation.source=none",))
FRAMES = 5


class RecordingSegmenter:
    """Segmenter without instances that records the predicted pose and the thread of each call."""

    def __init__(self) -> None:
        self.poses: list[torch.Tensor | None] = []
        self.threads: set[str] = set()

    def __call__(self, frame: RGBDFrame) -> Instances:
        raise AssertionError("called without a pose")

    def segment_with_pose(self, frame: RGBDFrame, T_cw: torch.Tensor | None) -> Instances:
        self.poses.append(T_cw)
        self.threads.add(threading.current_thread().name)
        return NoSegmentation()(frame)


def run(demo: RGBDSequence, *, ahead: bool) -> tuple[V3DSLAM, RecordingSegmenter]:
    segmenter = RecordingSegmenter()
    slam = V3DSLAM(demo.camera, segmenter, NO_NETWORK)
    with closing(FramePrefetcher((demo[index] for index in range(FRAMES)), slam, ahead=ahead)) as prefetcher:
        for preprocessed in prefetcher:
            slam.track(preprocessed)
    return slam, segmenter


def test_prefetched_frames_give_the_same_results_as_calls(demo: RGBDSequence) -> None:
    expected = RecordingSegmenter()
    called = V3DSLAM(demo.camera, expected, NO_NETWORK)
    for index in range(FRAMES):
        called(demo[index])
    for ahead in (False, True):
        slam, segmenter = run(demo, ahead=ahead)
        assert torch.equal(slam.poses.trajectory().T_wc, called.poses.trajectory().T_wc)
        for T_cw, expected_T_cw in zip(segmenter.poses, expected.poses, strict=True):
            assert T_cw is not None and expected_T_cw is not None and torch.equal(T_cw, expected_T_cw)


def test_thread_is_used_only_ahead(demo: RGBDSequence) -> None:
    main_thread = threading.current_thread().name
    assert run(demo, ahead=False)[1].threads == {main_thread}
    others = run(demo, ahead=True)[1].threads
    assert len(others) == 1 and main_thread not in others
    assert not others & {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize("ahead", [False, True])
def test_number_of_frames_read_ahead_is_limited(demo: RGBDSequence, ahead: bool) -> None:
    read: list[int] = []

    def frames() -> Iterator[RGBDFrame]:
        for index in range(FRAMES):
            read.append(index)
            yield demo[index]

    slam = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    with closing(FramePrefetcher(frames(), slam, ahead=ahead)) as prefetcher:
        for tracked, preprocessed in enumerate(prefetcher):
            slam.track(preprocessed)
            assert preprocessed.frame.index == tracked
            assert len(read) <= tracked + 1 + ahead * PREFETCHED_FRAMES
            times = {**preprocessed.read_times, **preprocessed.segmentation.times, **preprocessed.extraction.times}
            assert set(times) == {"read", "segmentation", "depth", "features"}
    assert read == list(range(FRAMES))


@pytest.mark.parametrize("ahead", [False, True])
def test_error_of_a_frame_is_raised_after_the_frames_before_it(demo: RGBDSequence, ahead: bool) -> None:
    def frames() -> Iterator[RGBDFrame]:
        yield from (demo[0], demo[1])
        raise InputError("depth/2.png: is truncated")

    slam = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    tracked: list[PreprocessedFrame] = []
    with (
        pytest.raises(InputError, match="truncated"),
        closing(FramePrefetcher(frames(), slam, ahead=ahead)) as prefetcher,
    ):
        for preprocessed in prefetcher:
            slam.track(preprocessed)
            tracked.append(preprocessed)
    assert [preprocessed.frame.index for preprocessed in tracked] == [0, 1]


def test_closing_early_stops_the_threads(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    before = set(threading.enumerate())
    prefetcher = FramePrefetcher((demo[index] for index in range(FRAMES)), slam, ahead=True)
    next(iter(prefetcher))
    threads = set(threading.enumerate()) - before
    assert len(threads) == 2
    prefetcher.close()
    assert not any(thread.is_alive() for thread in threads)


def test_pipeline_prefetches_as_configured(demo: RGBDSequence) -> None:
    for prefetch in (False, True):
        segmenter = RecordingSegmenter()
        config = NO_NETWORK.model_copy(update={"prefetch": prefetch})
        Pipeline(FirstFrames(demo, 3), V3DSLAM(demo.camera, segmenter, config))()
        assert (threading.current_thread().name in segmenter.threads) is not prefetch
