"""Interfaces of the sources of RGB-D frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame, Trajectory


@runtime_checkable
class RGBDStream(Protocol):
    """Any source of RGB-D frames in temporal order. A live camera is a stream without an end."""

    @property
    def name(self) -> str:
        """Short name, used in tables and messages."""

    @property
    def camera(self) -> PinholeCamera:
        """Camera of all frames."""

    @property
    def groundtruth(self) -> Trajectory | None:
        """Measured camera poses at their own timestamps; None if unavailable."""

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Iterate over the frames. Timestamps are strictly increasing, indices count from 0."""


@runtime_checkable
class LiveStream(RGBDStream, Protocol):
    """A stream whose frames arrive at their own rate, whether they are processed or not, such as a camera."""

    def captured_at(self, frame: RGBDFrame) -> float:
        """Return the time of capture of the newest frame in the clock of the computer (`time.monotonic`), seconds."""

    def stop(self) -> None:
        """End the iteration soon; can be called from another thread."""


@runtime_checkable
class DropsFrames(Protocol):
    """A stream that leaves out frames of its source to keep up with their rate."""

    @property
    def dropped(self) -> int:
        """Number of frames that were dropped since the iteration over the stream began."""


@runtime_checkable
class RGBDSequence(RGBDStream, Protocol):
    """A source with a fixed number of RGB-D frames that can be indexed."""

    @property
    def stamps(self) -> Tensor:
        """Timestamps of the colour images, seconds, float64, shape :math:`(N,)`, strictly increasing."""

    def __len__(self) -> int:
        """Number of frames."""

    def __getitem__(self, index: int) -> RGBDFrame:
        """Return frame ``index``, counted from 0.

        Raises:
            IndexError: If the sequence has no such frame.
        """


@runtime_checkable
class HasMotionMasks(Protocol):
    """A sequence with ground-truth motion masks, which only the evaluation reads."""

    def motion_mask(self, index: int) -> Tensor | None:
        """Return the ground-truth motion mask of frame ``index``; None if unknown.

        Returns:
            Mask, uint8, shape :math:`(H, W)`. 0 is static, 1-254 is the id of a person or thing that moves (the same in
            all frames), 255 is excluded from evaluation (a person whose outline is only approximate).
        """
