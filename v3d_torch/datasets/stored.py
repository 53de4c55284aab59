"""Sequences of stored frames, which can be read in any order."""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from typing import Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import depth_to_metres, estimate_depth_scale
from v3d_torch.types import RGBDFrame, Trajectory

_T = TypeVar("_T")

ReadGroundTruth = Callable[[], Trajectory | None]
"""Function that reads the ground truth; it returns None if the sequence has none."""

_MIN_MEDIAN_DEPTH, _MAX_MEDIAN_DEPTH = 0.05, 50.0
"""Plausible range for the median depth of an image, metres: wider than the range of any RGB-D camera, so that only a
wrong depth scale falls outside of it."""

_SAMPLES = 8
"""Number of frames from which an unknown depth scale is estimated."""


class StoredSequence(ABC):
    """Base class of every `RGBDSequence` with stored frames. A subclass reads the images of a frame.

    The constructor of a subclass ends with `_settle_depth_scale`.

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
        depth_scale_note: One sentence that says how the depth scale was estimated; None if it is stated.
    """

    registration_fix = "export depth that is registered to the colour image"
    """What to do if colour and depth have different sizes, for messages."""

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
        self._depth_delays = delays or [0.0] * len(stamps)
        self.groundtruth: Trajectory | None = None
        self.groundtruth_error: InputError | None = None
        self.depth_scale_note: str | None = None
        try:
            self.groundtruth = groundtruth() if groundtruth is not None else None
        except InputError as error:
            self.groundtruth_error = error

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
        stamp = float(self.stamps[index])
        return RGBDFrame(index, stamp, image, depth, camera=self.camera, depth_delay=self._depth_delays[index])

    def check_first_frame(self, source: object) -> None:
        """Decode the first frame, so that an error common to all frames is reported before anything is computed.

        Args:
            source: Path of the sequence, for messages.

        Raises:
            InputError: If the frame cannot be decoded or its median depth is implausible.
        """
        depth = self._read(0)[1]
        median = float(depth[depth > 0].median()) if bool((depth > 0).any()) else 1.0
        if _MIN_MEDIAN_DEPTH < median < _MAX_MEDIAN_DEPTH:
            return
        found = f"{source}: the median depth of the first frame is {median:.2g} m"
        if self._read_depth(0).dtype.kind == "f" or self.camera.depth_scale is None:
            raise InputError(f"{found}, although depth in floating point is in metres; export it in metres")
        raise InputError(
            f"{found} at {self.camera.depth_scale:g} units per metre; correct the camera's depth_scale (1000 if depth"
            " is in millimetres) or the depth images"
        )

    @abstractmethod
    def _sources(self, index: int) -> tuple[object, object]:
        """Return the origins of the colour and depth image of a frame, for messages."""

    @abstractmethod
    def _read_colour(self, index: int) -> Tensor:
        """Read the colour image of an existing frame, in the format of `RGBDFrame`."""

    @abstractmethod
    def _read_depth(self, index: int) -> NDArray[np.generic]:
        """Read the depth image of an existing frame: whole numbers in units, or metres in floating point, (H, W)."""

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        """Read the colour and depth image of an existing frame, in the format of `RGBDFrame`."""
        colour_source, depth_source = self._sources(index)
        image = self._read_colour(index)
        depth = depth_to_metres(self._read_depth(index), self.camera.depth_scale)
        depth_size, colour_size = (f"{each.shape[2]}x{each.shape[1]}" for each in (depth, image))
        if depth_size != colour_size:
            raise InputError(
                f"{depth_source}: has {depth_size} pixels, but its colour image has {colour_size};"
                f" {self.registration_fix}"
            )
        return self._check_size(colour_source, image), depth

    def _check_size(self, source: object, image: Tensor) -> Tensor:
        """Return the image (C, H, W) read from ``source`` if it has the camera's size."""
        height, width = image.shape[1:]
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{source}: has {width}x{height} pixels, but the camera has {self.camera.width}x{self.camera.height};"
                " pass the camera of these images with --camera"
            )
        return image

    def _settle_depth_scale(self, source: object, limit: int | None = None) -> None:
        """Estimate the depth scale if the camera does not state it and depth has whole numbers.

        Args:
            source: Path of the sequence, for messages.
            limit: Number of frames at the beginning from which images are sampled; None for all frames.

        Raises:
            InputError: If the first depth image cannot be read, or the images do not tell the depth scale.
        """
        if self.camera.depth_scale is not None:
            return
        images = [self._read_depth(0)]
        if images[0].dtype.kind == "f":
            return
        last = len(self) - 1 if limit is None else min(len(self), limit) - 1
        for index in dict.fromkeys(np.linspace(0, last, _SAMPLES).astype(int).tolist()):
            with suppress(InputError):  # reported when the frame is processed
                images += [self._read_depth(index)] if index else []
        estimate = estimate_depth_scale(images)
        if estimate.depth_scale is None:
            raise InputError(f"{source}: {estimate.question}")
        self.camera = replace(self.camera, depth_scale=estimate.depth_scale)
        self.depth_scale_note = estimate.note


class Cursor(Generic[_T]):
    """Random access to the items of a stream that can only be read forward.

    Reading forward continues the stream, reading backward starts it again.

    Args:
        start: Function that returns an iterator over all items.
    """

    def __init__(self, start: Callable[[], Iterator[_T]]) -> None:
        self._start = start
        self._items: Iterator[_T] = iter(())
        self._index: int | None = None
        self._item: _T | None = None

    def __getitem__(self, index: int) -> _T:
        """Return item ``index``, counted from 0.

        Raises:
            IndexError: If the stream has no such item.
        """
        if self._item is not None and index == self._index:
            return self._item
        if self._index is None or index < self._index:
            self._items, self._index = self._start(), -1
        self._item = next(islice(self._items, index - self._index - 1, None), None)
        self._index = index
        if self._item is None:
            self._index = None
            raise IndexError(index)
        return self._item
