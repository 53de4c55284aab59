"""The next frames are looked at while this one is tracked."""

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

_WORTH = 150
"""Frames for which a second process is begun: fewer are done soon after it is up, which takes some seconds."""

Upcoming = Callable[[], PreprocessedFrame | None]
"""Waits for what a frame shows; None behind the last."""


class FramePrefetcher:
    """What the frames show, for `V3DSLAM.track`, one after the other.

    Each frame is looked at with what was known of the camera some frames before: so it makes no difference to the
    results whether that happens when it is its turn, or ahead, in another thread or another process.

    Args:
        frames: to be read.
        slam: that looks at them, and takes each in before it asks for the next.
        ahead: whether the next frames are read and looked at while one is taken in: those of a stored sequence that is
            long enough by a second process, which is up when this is made, else, or if there is none to be had, by a
            thread.
    """

    def __init__(self, frames: Iterator[RGBDFrame], slam: V3DSLAM, *, ahead: bool) -> None:
        self._frames = frames
        self._slam = slam
        self._open = ExitStack()
        self._second: PreprocessWorker | None = None
        if ahead and isinstance(frames, FrameIterator) and frames.remaining >= _WORTH and _cores() > 1:
            second = self._open.enter_context(closing(PreprocessWorker(slam, frames.sequence)))
            self._second = second if second.is_alive else None
        self._thread = ThreadPoolExecutor(1, "perception") if ahead and self._second is None else None
        if self._thread is not None:
            self._open.callback(self._thread.shutdown, cancel_futures=True)

    def __iter__(self) -> Iterator[PreprocessedFrame]:
        """Go on with the next frame.

        Raises:
            V3DError: a frame cannot be read; those before have been given.
        """
        slam = self._slam
        upcoming = deque(map(self._begin, slam.outlooks, range(len(slam.outlooks))))
        while (percept := upcoming.popleft()()) is not None:
            upcoming.append(self._begin(slam.look_further(), len(upcoming)))
            yield percept

    def close(self) -> None:
        """End the thread or the process."""
        self._open.close()

    def _begin(self, outlook: PosePrediction | None, waiting: int) -> Upcoming:
        """Let a frame be looked at, behind those that are waited for already."""
        look = partial(self._look, torch.is_inference_mode_enabled(), outlook)
        if self._second is not None and isinstance(self._frames, FrameIterator) and waiting < self._frames.remaining:
            self._second.submit(self._frames.index + waiting, outlook)
            return partial(self._look_there, self._second, self._frames, look)
        return look if self._thread is None else self._thread.submit(look).result

    def _look(self, inference: bool, outlook: PosePrediction | None) -> PreprocessedFrame | None:
        """Read the next frame and look at it, here; ``inference`` tells whether without gradients."""
        clock = StageTimer()
        with clock("read"):
            frame = next(self._frames, None)
        if frame is None:
            return None
        with torch.inference_mode(inference):
            percept = self._slam.preprocess(frame, outlook)
        return replace(percept, seconds={**clock.seconds, **percept.seconds})

    def _look_there(
        self, second: PreprocessWorker, frames: FrameIterator, look_here: Upcoming
    ) -> PreprocessedFrame | None:
        """What the second process saw, as long as it can."""
        percept = second.result()
        if percept is None:
            return look_here()
        frames.index += 1
        return percept


def _cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
