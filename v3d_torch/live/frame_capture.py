"""Capture of frames in a thread that provides the newest frame."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from threading import Event, Thread

from v3d_torch.datasets.base import DropsFrames, LiveStream
from v3d_torch.errors import InputError
from v3d_torch.io.timestamps import round_timestamp
from v3d_torch.live.latest_queue import LatestQueue
from v3d_torch.runtime.clock import Clock
from v3d_torch.types import RGBDFrame

_LOG = logging.getLogger(__name__)

_MAX_REJECTED = 150
"""Number of consecutive frames out of order after which the clock of the source was set back: 5 s at 30 Hz."""

_JOIN_TIMEOUT = 2.0
"""Maximum wait for the end of the thread, seconds. A source that blocks for longer ends with the process."""


@dataclass(frozen=True)
class CapturedFrame:
    """A frame of a live source.

    Attributes:
        frame: Frame.
        number: Number of frames of the source so far, including this one and those that it skipped.
        captured_at: Time of capture in the clock of the computer, seconds.
    """

    frame: RGBDFrame
    number: int
    captured_at: float


class FrameCapture:
    """Thread that reads the frames of a source. Frames that are not later than all before them are rejected.

    Args:
        source: Frames at their own rate.
        check: Function that raises an error for a frame that is not valid; the error ends the capture.
        clock: Clock of the computer.

    Attributes:
        frames: Queue with the newest frame; closed after the last one, with the error if there was one.
        rejected: Number of frames that were rejected.
    """

    def __init__(self, source: Iterable[RGBDFrame], check: Callable[[RGBDFrame], None], clock: Clock) -> None:
        self.frames = LatestQueue[CapturedFrame]()
        self.rejected = 0
        self._source = source
        self._check = check
        self._clock = clock
        self._newest_stamp = -float("inf")
        self._rejected_in_a_row = 0
        self._stop = Event()
        self._thread = Thread(target=self._run, name="capture", daemon=True)

    @property
    def is_waiting(self) -> bool:
        """True if the thread has not ended, because it waits for the next frame of the source."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Close the queue of frames, and stop the source if it is a `LiveStream`; can be called from any thread."""
        self._stop.set()
        self.frames.close()
        if isinstance(self._source, LiveStream):
            self._source.stop()

    def close(self) -> None:
        """Stop, and wait for the end of the thread."""
        self.stop()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_TIMEOUT)
            if self._thread.is_alive():
                _LOG.warning("the source of the frames does not end: a thread waits for its next frame; end the source")

    def _run(self) -> None:
        try:
            accepted = 0
            for frame in self._source:
                now = self._clock.now()
                if self._stop.is_set():
                    break
                self._check(frame)
                if self._is_in_order(frame):
                    accepted += 1
                    skipped = self._source.dropped if isinstance(self._source, DropsFrames) else 0
                    captured_at = self._source.captured_at(frame) if isinstance(self._source, LiveStream) else now
                    self.frames.put(CapturedFrame(frame, accepted + skipped, captured_at))
        except BaseException as error:
            self.frames.close(error)
        else:
            self.frames.close()

    def _is_in_order(self, frame: RGBDFrame) -> bool:
        """Check whether a frame is later than all before; the first frame of several out of order is logged."""
        if round_timestamp(frame.stamp) > round_timestamp(self._newest_stamp):
            self._newest_stamp, self._rejected_in_a_row = frame.stamp, 0
            return True
        if not self._rejected_in_a_row:
            _LOG.warning(
                "frame %d is rejected: its stamp, %.6f s, is not after %.6f s, that of an earlier frame",
                frame.index, frame.stamp, self._newest_stamp,
            )  # fmt: skip
        self.rejected += 1
        self._rejected_in_a_row += 1
        if self._rejected_in_a_row == _MAX_REJECTED:
            raise InputError(
                f"frame {frame.index}: its stamp, {frame.stamp:.6f} s, and those of {_MAX_REJECTED - 1} frames before"
                f" are not after {self._newest_stamp:.6f} s: the clock of the source was set back; start again"
            )
        return False
