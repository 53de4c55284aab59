"""Playback of a stored source at its own rate, as if it were a live camera."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event

import torch

from v3d_torch.datasets.base import LiveStream, RGBDSequence, RGBDStream
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.runtime.clock import MONOTONIC_CLOCK, Clock
from v3d_torch.types import RGBDFrame, Trajectory

_STOPPABLE_WAIT = 0.1
"""Longest time of one wait, seconds: a recording can have gaps of minutes, in which `stop` ends the iteration, too."""


class RealtimePlayback:
    """Live stream of the frames of a source: each frame arrives at the time of its stamp, relative to the first frame.

    Each frame is read before it is due. Frames of a sequence that are already due when the next one is read are
    dropped, as a camera does not wait, so that a slow computer does not fall behind. A frame counts as captured when it
    is due, even if reading it took longer.

    Args:
        source: Source of frames.
        clock: Clock of the computer.

    Attributes:
        dropped: Number of frames that were dropped since the iteration began.

    Raises:
        InputError: If the source is already live.
    """

    def __init__(self, source: RGBDStream, clock: Clock = MONOTONIC_CLOCK) -> None:
        if isinstance(source, LiveStream):
            raise InputError(f"{source.name}: is a live camera, which always has its own rate; remove --realtime")
        self.source = source
        self.dropped = 0
        self._clock = clock
        self._offset = 0.0  # clock of the computer minus clock of the source, seconds
        self._stopped = Event()

    @property
    def name(self) -> str:
        """Name of the source."""
        return self.source.name

    @property
    def camera(self) -> PinholeCamera:
        """Camera of all frames."""
        return self.source.camera

    @property
    def groundtruth(self) -> Trajectory | None:
        """Measured camera poses; None if unavailable."""
        return self.source.groundtruth

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Yield each frame when it is due."""
        self._stopped.clear()
        self.dropped = 0
        source, is_first = self.source, True
        for frame in self._newest_frames(source) if isinstance(source, RGBDSequence) else source:
            if is_first:
                self._offset, is_first = self._clock.now() - frame.stamp, False
            while not self._stopped.is_set() and (wait := self.captured_at(frame) - self._clock.now()) > 0:
                self._clock.sleep(min(wait, _STOPPABLE_WAIT))
            if self._stopped.is_set():
                return
            yield frame

    def captured_at(self, frame: RGBDFrame) -> float:
        """Return the time at which a frame is due, in the clock of the computer, seconds."""
        return frame.stamp + self._offset

    def stop(self) -> None:
        """End the iteration before its next frame, within a fraction of a second also in a gap of the recording."""
        self._stopped.set()

    def _newest_frames(self, sequence: RGBDSequence) -> Iterator[RGBDFrame]:
        """Yield the first frame of a sequence, and after each frame the next one that is not due yet, or the last."""
        stamps, index = sequence.stamps, 0
        while index < len(stamps):
            yield sequence[index]
            due = int(torch.searchsorted(stamps, self._clock.now() - self._offset))
            following = max(index + 1, min(due, len(stamps) - 1))
            self.dropped += following - index - 1
            index = following


def stored_source(source: RGBDStream) -> RGBDStream:
    """Return the source that a `RealtimePlayback` plays; any other source is returned unchanged.

    A playback is a stream, but what is known of the stored sequence, such as its notes and extent, holds for it too.
    """
    return source.source if isinstance(source, RealtimePlayback) else source
