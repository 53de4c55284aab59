"""Playback of a stored source at its own rate, as if it were a live camera."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event

from v3d_torch.datasets.base import LiveStream, RGBDStream
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.runtime.clock import MONOTONIC_CLOCK, Clock
from v3d_torch.types import RGBDFrame, Trajectory


class RealtimePlayback:
    """Live stream of the frames of a source: each frame arrives at the time of its stamp, relative to the first frame.

    A frame counts as captured when it is due, even if reading it took longer.

    Args:
        source: Source of frames.
        clock: Clock of the computer.

    Raises:
        InputError: If the source is already live.
    """

    def __init__(self, source: RGBDStream, clock: Clock = MONOTONIC_CLOCK) -> None:
        if isinstance(source, LiveStream):
            raise InputError(f"{source.name}: is a live camera, which always has its own rate; remove --realtime")
        self.source = source
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
        is_first = True
        for frame in self.source:
            if is_first:
                self._offset, is_first = self._clock.now() - frame.stamp, False
            self._clock.sleep(self.captured_at(frame) - self._clock.now())
            if self._stopped.is_set():
                return
            yield frame

    def captured_at(self, frame: RGBDFrame) -> float:
        """Return the time at which a frame is due, in the clock of the computer, seconds."""
        return frame.stamp + self._offset

    def stop(self) -> None:
        """End the iteration before its next frame."""
        self._stopped.set()
