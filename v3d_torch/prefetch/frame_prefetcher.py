"""Preprocessing of the next frames while the current one is tracked."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial

import torch

from v3d_torch.datasets.stored import FrameIterator
from v3d_torch.frame_result import PreprocessedFrame
from v3d_torch.prefetch.preprocess_worker import PreprocessWorker
from v3d_torch.runtime.stage_timer import StageTimer
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import RGBDFrame

_MIN_FRAMES_FOR_WORKER = 150
"""A second process takes seconds to start, so shorter sequences use a thread."""

PendingFrame = Callable[[], PreprocessedFrame | None]
"""Waits for a preprocessed frame; returns None after the last one."""


class FramePrefetcher:
    """Iterator over preprocessed frames for `V3DSLAM.track`.

    Each frame is preprocessed with the pose prediction made some frames before. Therefore the results do not depend on
    whether it is preprocessed in turn, ahead in a thread, or ahead in a second process.

    Args:
        frames: Frames to read.
        slam: System that preprocesses the frames, and tracks each before it requests the next.
        ahead: True to read and preprocess the next frames while one is tracked: in a second process if the frames
            come from a stored sequence that is long enough, else in a thread. The process is ready when the
            constructor returns.
    """

    def __init__(self, frames: Iterator[RGBDFrame], slam: V3DSLAM, *, ahead: bool) -> None:
        self._frames = frames
        self._slam = slam
        self._resources = ExitStack()
        self._worker: PreprocessWorker | None = None
        if (
            ahead
            and isinstance(frames, FrameIterator)
            and frames.remaining >= _MIN_FRAMES_FOR_WORKER
            and _available_cores() > 1
        ):
            worker = self._resources.enter_context(closing(PreprocessWorker(slam, frames.sequence)))
            self._worker = worker if worker.is_alive else None
        self._thread = ThreadPoolExecutor(1, "preprocessing") if ahead and self._worker is None else None
        if self._thread is not None:
            self._resources.callback(self._thread.shutdown, cancel_futures=True)

    def __iter__(self) -> Iterator[PreprocessedFrame]:
        """Yield the next preprocessed frames.

        Raises:
            V3DError: If a frame cannot be read; all frames before it have been yielded.
        """
        slam = self._slam
        pending = deque(map(self._submit, slam.predictions, range(len(slam.predictions))))
        while (preprocessed := pending.popleft()()) is not None:
            pending.append(self._submit(slam.advance_predictions(), len(pending)))
            yield preprocessed

    def close(self) -> None:
        """Stop the thread or the process."""
        self._resources.close()

    def _submit(self, prediction: PosePrediction | None, pending: int) -> PendingFrame:
        """Start to preprocess the frame that follows the pending ones."""
        preprocess = partial(self._preprocess, torch.is_inference_mode_enabled(), prediction)
        if self._worker is not None and isinstance(self._frames, FrameIterator) and pending < self._frames.remaining:
            self._worker.submit(self._frames.index + pending, prediction)
            return partial(self._receive, self._worker, self._frames, preprocess)
        return preprocess if self._thread is None else self._thread.submit(preprocess).result

    def _preprocess(self, inference: bool, prediction: PosePrediction | None) -> PreprocessedFrame | None:
        """Read and preprocess the next frame in this process, without gradients if ``inference``."""
        timer = StageTimer()
        with timer("read"):
            frame = next(self._frames, None)
        if frame is None:
            return None
        with torch.inference_mode(inference):
            preprocessed = self._slam.preprocess(frame, prediction)
        return replace(preprocessed, times={**timer.times, **preprocessed.times})

    def _receive(
        self, worker: PreprocessWorker, frames: FrameIterator, preprocess_here: PendingFrame
    ) -> PreprocessedFrame | None:
        """Return the result of the second process; if it has failed, preprocess the frame in this process."""
        preprocessed = worker.result()
        if preprocessed is None:
            return preprocess_here()
        frames.index += 1
        return preprocessed


def _available_cores() -> int:
    """Return the number of processors that this process can use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
