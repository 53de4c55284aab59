"""Rolling-shutter compensation: the rows of an image are read one after the other while the camera moves.

Features are moved to where they would have been observed at the time of the middle row (cf. Hedborg et al., Rolling
Shutter Bundle Adjustment, CVPR 2012). The shift of a feature is its readout Jacobian times the readout: the readout is
the time from the first to the last row, and the readout Jacobian is the motion field times the feature's row, from -1/2
to 1/2, with opposite sign. An unknown readout is calibrated while mapping.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from v3d_torch.config import RollingShutterConfig
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.geometry.motion_field import motion_field
from v3d_torch.kernels import time_compensation as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array


@dataclass(frozen=True)
class Readout:
    """Estimate of the readout, the time that a camera takes to read the rows of its colour image.

    Attributes:
        seconds: Time from the first to the last row, seconds; 0 for a global shutter, negative if the rows are read
            from the bottom up.
        information: Inverse variance of ``seconds``, 1/s^2; infinite if the readout is known exactly.
    """

    seconds: float
    information: float

    @property
    def is_certain(self) -> bool:
        """True if the readout is known exactly and needs no calibration."""
        return math.isinf(self.information)

    @classmethod
    def from_camera(cls, camera: PinholeCamera, prior: RollingShutterConfig) -> Readout:
        """The camera's readout if it is known, else the prior.

        Args:
            camera: Camera, with or without a readout.
            prior: Expected readout and its standard deviation.
        """
        if camera.readout is not None:
            return cls(camera.readout, math.inf)
        return cls(prior.readout, prior.readout_sigma**-2)

    @classmethod
    def from_dict(cls, attributes: Mapping[str, float]) -> Readout:
        """Create a readout from its attributes by name.

        Args:
            attributes: ``seconds`` and ``information``.

        Raises:
            ValueError: If the readout is out of range or not a number.
        """
        seconds, information = float(attributes["seconds"]), float(attributes["information"])
        if not (abs(seconds) <= MAX_READOUT and information >= 0):
            raise ValueError(f"the readout is {seconds} s; expected at most {MAX_READOUT} s")
        return cls(seconds, information)


GLOBAL_SHUTTER = Readout(0.0, math.inf)
"""Readout of a camera that reads all rows at once."""


def _compensate_compiled(
    self: RollingShutterCompensation, features: Features, velocity: Tensor, readout: Readout
) -> Features:
    if velocity.dtype != torch.float64 or features.uv.requires_grad:
        return NotImplemented
    camera = self._camera
    uv, readout_jacobian = kernels.compensate_rolling_shutter(
        to_array(features.uv),
        to_array(features.pixel),
        to_array(features.inverse_depth),
        to_array(features.readout_jacobian),
        to_array(velocity),
        readout.seconds,
        camera.height,
        (camera.fx, camera.fy, camera.cx, camera.cy),
    )
    return replace(features, uv=torch.from_numpy(uv), readout_jacobian=torch.from_numpy(readout_jacobian))


class RollingShutterCompensation:
    """Moves features to where they would have been observed at the time of the middle row.

    Args:
        camera: Intrinsics of the camera that observed the features.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera

    @compiled_by(_compensate_compiled)
    def __call__(self, features: Features, velocity: Tensor, readout: Readout) -> Features:
        """Compensate the rolling shutter of a moving camera.

        Args:
            features: Features as observed, or compensated with the same readout and another velocity.
            velocity: Twist per second ``[m/s, rad/s]`` by which static points move in the camera frame, float64, shape
                :math:`(6,)`.
            readout: Readout of the camera.

        Returns:
            The features with ``uv`` and ``readout_jacobian`` for this velocity.
        """
        observed = features.uv - readout.seconds * features.readout_jacobian
        pixel_velocity, _ = motion_field(observed, features.inverse_depth, velocity, self._camera)
        row = features.pixel[:, 1:].to(torch.float64) / (self._camera.height - 1) - 0.5  # from -0.5 to 0.5
        readout_jacobian = -row * pixel_velocity
        return replace(features, uv=observed + readout.seconds * readout_jacobian, readout_jacobian=readout_jacobian)
