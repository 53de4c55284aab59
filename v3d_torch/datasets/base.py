"""What every source of frames offers."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.types import RGBDFrame, Trajectory


@runtime_checkable
class RGBDSequence(Protocol):
    """A sequence of RGB-D frames in order of time. Iterating over it works too, by ``__getitem__``."""

    @property
    def name(self) -> str:
        """Short name, as it stands in tables."""

    @property
    def camera(self) -> PinholeCamera:
        """The camera that took all frames."""

    @property
    def stamps(self) -> Tensor:
        """Time of each colour image, seconds, float64, shape :math:`(N,)`, strictly increasing."""

    @property
    def groundtruth(self) -> Trajectory | None:
        """Measured camera poses, at their own stamps; None where there are none."""

    def __len__(self) -> int:
        """Number of frames."""

    def __getitem__(self, index: int) -> RGBDFrame:
        """Frame ``index``, from 0; raises IndexError behind the last."""
