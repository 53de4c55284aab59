"""Sequences of stored frames, which can be read in any order."""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.datasets.groundtruth import ReadGroundTruth
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame, Trajectory


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
        self._groundtruth_note: str | None = None
        try:
            truth = groundtruth() if groundtruth is not None else None
        except InputError as error:
            self.groundtruth_error = error
            return
        if truth is not None:
            self.groundtruth = truth.trajectory if len(truth.trajectory) else None
            self._groundtruth_note = truth.note

    @property
    def notes(self) -> list[str]:
        """Sentences about the sequence that a user needs to know before a run."""
        if self.groundtruth_error is not None:
            return [f"the ground truth cannot be read: {self.groundtruth_error}"]
        return [] if self._groundtruth_note is None else [self._groundtruth_note]

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
