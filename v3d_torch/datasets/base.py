"""What every source of frames offers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame, Trajectory


@runtime_checkable
class RGBDStream(Protocol):
    """RGB-D frames in order of time, taken one after the other. It may have no end, as a live camera."""

    @property
    def name(self) -> str:
        """Short name, as it stands in tables."""

    @property
    def camera(self) -> PinholeCamera:
        """The camera that took all frames."""

    @property
    def groundtruth(self) -> Trajectory | None:
        """Measured camera poses, at their own stamps; None where there are none."""

    def __iter__(self) -> Iterator[RGBDFrame]:
        """All frames; stamps are strictly increasing, indices count from 0."""


@runtime_checkable
class RGBDSequence(RGBDStream, Protocol):
    """RGB-D frames of a known number, in any order."""

    @property
    def stamps(self) -> Tensor:
        """Time of each colour image, seconds, float64, shape :math:`(N,)`, strictly increasing."""

    def __len__(self) -> int:
        """Number of frames."""

    def __getitem__(self, index: int) -> RGBDFrame:
        """Frame ``index``, from 0; raises IndexError behind the last."""


@runtime_checkable
class HasMotionMasks(Protocol):
    """A sequence that has true masks besides its frames. They are for evaluation: the system must not see them."""

    def motion_mask(self, index: int) -> Tensor | None:
        """What moves in frame ``index``; None where it is not known.

        Returns:
            0 for what is static, 1-254 for a person who moves, the same in all frames, 255 for what belongs to
            neither (a person who is only about there), uint8, shape :math:`(H, W)`.
        """
