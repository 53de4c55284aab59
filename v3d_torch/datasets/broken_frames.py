"""Maximum number of broken frames of a stored sequence, and its first frame that is not broken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TypeVar

from v3d_torch.errors import InputError

_S = TypeVar("_S")
_T = TypeVar("_T")

_MAX_BROKEN_FRACTION, _MIN_BROKEN_LIMIT = 0.05, 10
"""Maximum number of broken frames that are skipped on request: this fraction of the frames, or this number if it is
larger. A sequence with more broken frames was probably copied incompletely, or opened with the wrong camera."""


def max_broken_frames(frames: int) -> int:
    """Return the maximum number of broken frames that can be skipped in a sequence of this length."""
    return max(int(_MAX_BROKEN_FRACTION * frames), _MIN_BROKEN_LIMIT)


def first_readable(read: Callable[[_S], _T], frames: Sequence[_S]) -> _T:
    """Read the first frame that is not broken, of as many frames as can be skipped and one more.

    Args:
        read: Function that reads something of a frame, and raises InputError if the frame is broken.
        frames: Frames, at least one, such as their indices or their files.

    Raises:
        InputError: If none of these frames can be read; the error is that of the first one.
    """
    for frame in frames[: max_broken_frames(len(frames)) + 1]:
        with suppress(InputError):
            return read(frame)
    return read(frames[0])
