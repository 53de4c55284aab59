"""Preprocessing of the next frames while the current one is tracked."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from v3d_torch.frame_result import Extraction, PreprocessedFrame, Segmentation
from v3d_torch.runtime.inference_mode import in_current_mode
from v3d_torch.runtime.stage_timer import StageTime, StageTimer
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import RGBDFrame

PendingFrame = Callable[[], PreprocessedFrame | None]
"""Function that waits for a preprocessed frame; returns None after the last frame."""


class _ReadFrame(NamedTuple):
    """A frame and the time that reading it took, by stage."""

    frame: RGBDFrame
    times: dict[str, StageTime]


class FramePrefetcher:
    """Iterator over preprocessed frames for `V3DSLAM.track`.

    Each frame is preprocessed with the pose prediction made some frames before. Therefore the results are the same
    whether it is preprocessed in turn or ahead.

    One thread reads the frames and extracts their features, another thread segments them. Both process the frames in
    order, and spend most of their time in compiled code that releases the GIL.

    Args:
        frames: Frames to read.
        slam: System that preprocesses the frames; each frame must be tracked before the next one is requested.
        ahead: True to read and preprocess the next frames while one is tracked.
    """

    def __init__(self, frames: Iterator[RGBDFrame], slam: V3DSLAM, *, ahead: bool) -> None:
        self._frames = frames
        self._slam = slam
        self._ahead = ahead
        self._resources = ExitStack()
        self._reader, self._segmenter = (ThreadPoolExecutor(1, name) for name in ("features", "segmentation"))
        for executor in (self._reader, self._segmenter):
            self._resources.callback(executor.shutdown, cancel_futures=True)

    def __iter__(self) -> Iterator[PreprocessedFrame]:
        """Yield the next preprocessed frames.

        Raises:
            V3DError: If a frame cannot be read; all frames before it have been yielded.
        """
        slam = self._slam
        pending = deque(map(self._submit, slam.predictions))
        while (preprocessed := pending.popleft()()) is not None:
            pending.append(self._submit(slam.advance_predictions()))
            yield preprocessed

    def close(self) -> None:
        """Stop the threads."""
        self._resources.close()

    def _submit(self, prediction: PosePrediction | None) -> PendingFrame:
        """Start to read and preprocess the next frame."""
        if not self._ahead:
            return partial(self._preprocess, prediction)
        frame = self._reader.submit(in_current_mode(self._read))
        segmentation = self._segmenter.submit(in_current_mode(self._segment), frame, prediction)
        extraction = self._reader.submit(in_current_mode(self._extract), frame)
        return partial(_combine, frame, segmentation, extraction)

    def _preprocess(self, prediction: PosePrediction | None) -> PreprocessedFrame | None:
        """Read and preprocess the next frame in this thread."""
        read = self._read()
        if read is None:
            return None
        return replace(self._slam.preprocess(read.frame, prediction), read_times=read.times)

    def _read(self) -> _ReadFrame | None:
        timer = StageTimer()
        with timer("read"):
            frame = next(self._frames, None)
        if frame is None:
            return None
        self._slam.check(frame)
        return _ReadFrame(frame, timer.times)

    def _segment(self, read: Future[_ReadFrame | None], prediction: PosePrediction | None) -> Segmentation | None:
        return None if (each := read.result()) is None else self._slam.segment_instances(each.frame, prediction)

    def _extract(self, read: Future[_ReadFrame | None]) -> Extraction | None:
        return None if (each := read.result()) is None else self._slam.extract_features(each.frame)


def _combine(
    read: Future[_ReadFrame | None], segmentation: Future[Segmentation | None], extraction: Future[Extraction | None]
) -> PreprocessedFrame | None:
    """Wait for the parts of a frame; None after the last frame."""
    each, segmented, extracted = read.result(), segmentation.result(), extraction.result()
    if each is None or segmented is None or extracted is None:
        return None
    return PreprocessedFrame(each.frame, extracted, lambda: segmented, each.times)
