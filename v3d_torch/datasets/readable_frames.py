"""Iteration over a sequence that skips broken frames."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from v3d_torch.datasets.broken_frames import max_broken_frames
from v3d_torch.errors import InputError
from v3d_torch.types import RGBDFrame

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class BrokenFrame:
    """A frame that was skipped because it is broken.

    Attributes:
        index: Position in the sequence, from 0.
        reason: Error message of the frame.
    """

    index: int
    reason: str


class ReadableFrames:
    """Iterator over a sequence that skips frames that cannot be read or whose images have another kind or size.

    Args:
        frames: Frames from ``start`` on; an iterator that continues after an InputError.
        start: Index of the first frame.
        total: Number of frames of the sequence.
        broken_before: Number of broken frames before ``start``, which count towards the limit.

    Attributes:
        broken: Skipped frames, in order. The consumer removes them, possibly in another thread.
    """

    def __init__(self, frames: Iterator[RGBDFrame], start: int, total: int, broken_before: int = 0) -> None:
        self.broken: deque[BrokenFrame] = deque()
        self._frames = frames
        self._next = start
        self._total = total
        self._count = broken_before
        self._limit = max_broken_frames(total)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return self

    def __next__(self) -> RGBDFrame:
        """Return the next frame that can be read.

        Raises:
            InputError: If more frames are broken than `max_broken_frames`.
        """
        while True:
            try:
                frame = next(self._frames)
            except InputError as error:
                if self._next == self._total:  # after the last frame: an error of the whole sequence
                    raise
                self._skip(error)
            else:
                self._next += 1
                return frame

    def _skip(self, error: InputError) -> None:
        if self._count == self._limit:
            raise InputError(
                f"{error}; {self._limit + 1} of {self._total} frames are broken, and --skip-broken skips at most"
                f" {self._limit}"
            ) from error
        _LOG.warning("frame %d is broken and skipped: %s", self._next, error)
        self.broken.append(BrokenFrame(self._next, str(error)))
        self._count += 1
        self._next += 1
