"""Constant-velocity motion model of the camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from v3d_torch.geometry.se3 import se3_exp


@dataclass(frozen=True)
class PosePrediction:
    """How a camera is expected to go on from where it was.

    Attributes:
        stamp: of the frame that this was after, seconds.
        T_cw: of that frame, world to camera, float64, shape :math:`(4, 4)`.
        velocity: twist per second, in the camera frame, float64, shape :math:`(6,)`.
    """

    stamp: float
    T_cw: Tensor
    velocity: Tensor

    LONGEST: ClassVar[float] = 0.2  # seconds: a hand changes its motion within that; then a lost camera stands still

    def at(self, stamp: float) -> Tensor:
        """``T_cw`` at ``stamp`` with constant velocity."""
        elapsed = min(stamp - self.stamp, self.LONGEST)
        return se3_exp(self.velocity * elapsed) @ self.T_cw
