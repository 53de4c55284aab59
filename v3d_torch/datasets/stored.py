"""Sequences of stored frames, which can be read in any order."""

from __future__ import annotations

import operator
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Generic, TypeVar

import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame, Trajectory

_S = TypeVar("_S")
_T = TypeVar("_T")

ReadGroundTruth = Callable[[], Trajectory | None]
"""Function that reads the ground truth; it returns None if the sequence has none."""

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


class StoredSequence(ABC):
    """Base class of every `RGBDSequence` with stored frames. A subclass reads the images of a frame.

    Args:
        name: Name of the sequence, used in tables.
        stamps: Timestamps of the colour images, seconds, strictly increasing.
        camera: Camera of all frames.
        groundtruth: Function that reads the measured poses of the camera.
        delays: Depth delay of each frame (depth stamp minus colour stamp), seconds; None if it is always 0.

    Attributes:
        groundtruth: Measured poses of the camera; None if there are none or they cannot be read. The frames remain
            usable without them.
        groundtruth_error: Error that occurred while reading the ground truth; None if it was read.
        gravity: Direction of gravity at the first frame, a unit vector in its camera frame, float64, shape
            :math:`(3,)`; None if it was not measured.
    """

    def __init__(
        self,
        name: str,
        stamps: Sequence[float],
        camera: PinholeCamera,
        groundtruth: ReadGroundTruth | None = None,
        delays: Sequence[float] | None = None,
    ) -> None:
        self.name = name.encode(errors="replace").decode()  # the name of a folder can be invalid UTF-8
        self.stamps: Tensor = torch.tensor(stamps, dtype=torch.float64)
        self.camera = camera
        self.gravity: Tensor | None = None
        self._depth_delays = delays or [0.0] * len(stamps)
        self.groundtruth: Trajectory | None = None
        self.groundtruth_error: InputError | None = None
        try:
            self.groundtruth = groundtruth() if groundtruth is not None else None
        except InputError as error:
            self.groundtruth_error = error

    @property
    def notes(self) -> list[str]:
        """Sentences about the sequence that a user needs to know before a run."""
        error = self.groundtruth_error
        return [] if error is None else [f"the ground truth cannot be read: {error}"]

    def __len__(self) -> int:
        return self.stamps.shape[0]

    def __iter__(self) -> Iterator[RGBDFrame]:
        return self.frames_from(0)

    def frames_from(self, index: int) -> Iterator[RGBDFrame]:
        """Iterate over the frames from ``index`` on. Each frame is decoded when it is requested."""
        return map(self.__getitem__, range(index, len(self)))

    def __getitem__(self, index: int) -> RGBDFrame:
        """Decode frame ``index``, counted from 0.

        Raises:
            IndexError: If the sequence has no such frame.
            InputError: If an image is damaged, of the wrong kind or not of the camera's size, or if ``index`` is not
                an integer.
        """
        try:
            index = operator.index(index)
        except TypeError as error:
            raise InputError(
                f"{self.name}: a frame index must be an integer, got {index!r}; read several frames with"
                " itertools.islice(sequence, start, stop)"
            ) from error
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} frames, index {index} is out of range")
        image, depth = self._read(index)
        return RGBDFrame(
            index,
            float(self.stamps[index]),
            image,
            self.camera.correct_depth(depth),
            camera=self.camera,
            depth_delay=self._depth_delays[index],
            gravity=self.gravity if index == 0 else None,
        )

    def files(self, index: int) -> tuple[Path, ...]:
        """Return the files that contain only frame ``index``; empty if all frames share their files."""
        return ()

    @abstractmethod
    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        """Read the colour and depth image of an existing frame, in the format of `RGBDFrame`."""


class Cursor(Generic[_T]):
    """Random access to the items of a stream that can only be read forward.

    Reading forward continues the stream; reading backward restarts it, and so do reading after an error, and another
    process, to which a cursor was copied or pickled.

    Args:
        start: Function that returns an iterator over all items.
    """

    def __init__(self, start: Callable[[], Iterator[_T]]) -> None:
        self._start = start
        self._process = os.getpid()
        self._items: Iterator[_T] = iter(())
        self._index: int | None = None
        self._item: _T | None = None

    def __getitem__(self, index: int) -> _T:
        """Return item ``index``, counted from 0.

        Raises:
            IndexError: If the stream has no such item.
        """
        if self._process != os.getpid():
            # A process that was forked shares the position in open files with its parent. The files are not closed,
            # because a decoder would wait for its threads, which are not in this process.
            self._of_parent = self._items
            self._process, self._index, self._item = os.getpid(), None, None
        if self._item is not None and index == self._index:
            return self._item
        if self._index is None or index < self._index:
            self._items, self._index = self._start(), -1
        following = islice(self._items, index - self._index - 1, None)
        self._index = self._item = None  # a stream that raises or ends cannot be continued
        if (item := next(following, None)) is None:
            raise IndexError(index)
        self._index, self._item = index, item
        return item

    def __reduce__(self) -> tuple[type[Cursor[_T]], tuple[Callable[[], Iterator[_T]]]]:
        """Pickle the start of the stream alone."""
        return Cursor, (self._start,)
