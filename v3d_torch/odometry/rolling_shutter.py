"""The rolling shutter: the rows of an image are read one after the other, while the camera moves on.

A Kinect takes most of the 33 ms between two frames to read its colour image, and a turn of 1 rad/s moves the image by
some 13 pixels meanwhile, more than any other error (Hedborg et al., Rolling Shutter Bundle Adjustment, CVPR 2012).
Features are put where they would have been seen at the time of the middle row. How far a feature has to go is its
drift, the motion field times the share of the readout by which its row is late; how long the readout takes, the map
tells.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from v3d_torch.config import RollingShutterConfig
from v3d_torch.features.orb import Features
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.geometry.motion_field import motion_field


@dataclass(frozen=True)
class Readout:
    """How long a camera takes to read the rows of its colour image, as far as is known.

    Attributes:
        seconds: from the first row to the last; 0 is a global shutter, less than 0 one that is read from below.
        information: inverse variance of that, 1/s^2.
    """

    seconds: float
    information: float

    @property
    def is_certain(self) -> bool:
        """Whether no image can tell another."""
        return math.isinf(self.information)

    @classmethod
    def from_camera(cls, camera: PinholeCamera, expected: RollingShutterConfig) -> Readout:
        """What the camera says of itself, for sure; what is to be expected, where it says nothing."""
        if camera.readout is not None:
            return cls(camera.readout, math.inf)
        return cls(expected.readout, expected.readout_sigma**-2)

    @classmethod
    def from_dict(cls, about: Mapping[str, float]) -> Readout:
        """From the attributes by their names.

        Raises:
            ValueError: there is no such camera.
        """
        seconds, information = float(about["seconds"]), float(about["information"])
        if not (abs(seconds) <= MAX_READOUT and information >= 0):
            raise ValueError(f"a readout of {seconds} s")
        return cls(seconds, information)


GLOBAL_SHUTTER = Readout(0.0, math.inf)
"""All rows at once, for sure."""


class RollingShutterCompensation:
    """Puts features where they would have been seen at the time of the middle row.

    Args:
        camera: that read them.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera

    def __call__(self, features: Features, velocity: Tensor, readout: Readout) -> Features:
        """Features of a camera in motion.

        Args:
            features: as they were read, or as they were put with the same readout for another velocity.
            velocity: of the points in the camera, twist per second, float64, shape :math:`(6,)`.
            readout: of the camera.

        Returns:
            The same features with ``uv`` and ``readout_jacobian`` for that velocity.
        """
        read = features.uv - readout.seconds * features.readout_jacobian
        field, _ = motion_field(read, features.inverse_depth, velocity, self._camera)
        late = features.pixel[:, 1:].to(torch.float64) / (self._camera.height - 1) - 0.5
        drift = -late * field
        return replace(features, uv=read + readout.seconds * drift, readout_jacobian=drift)
