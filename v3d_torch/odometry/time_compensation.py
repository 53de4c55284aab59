"""Compensation of the times at which the rows of colour and depth were read, for a moving camera."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import MIN_DEPTH, Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import time_compensation as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.odometry.depth_delay import DepthDelayCompensation
from v3d_torch.odometry.rolling_shutter import Readout, RollingShutterCompensation


def _compensate_compiled(
    self: TimeCompensation, features: Features, depth: Tensor, depth_delay: float, velocity: Tensor, readout: Readout
) -> Features:
    if depth.dtype != torch.float32 or velocity.dtype != torch.float64 or features.uv.requires_grad:
        return NotImplemented
    camera, delay = self.camera, depth_delay if self.config.rolling_shutter.enabled else 0.0
    compensated = kernels.compensate(
        to_array(features.uv),
        to_array(features.pixel),
        to_array(features.depth),
        to_array(features.readout_jacobian),
        to_array(depth[0]),
        to_array(velocity),
        delay,
        readout.seconds,
        camera.height,
        MIN_DEPTH,
        self.config.features.max_depth,
        (camera.fx, camera.fy, camera.cx, camera.cy),
    )
    uv, new_depth, readout_jacobian = map(torch.from_numpy, compensated)
    return replace(features, uv=uv, depth=new_depth, readout_jacobian=readout_jacobian)


class TimeCompensation:
    """Moves features to where a global shutter, with simultaneous depth, would have observed them.

    Args:
        config: Configuration of the whole system.
        camera: Camera of all frames.

    Attributes:
        config: Configuration of the whole system.
        camera: Camera of all frames.
    """

    def __init__(self, config: Config, camera: PinholeCamera) -> None:
        self.config = config
        self.camera = camera
        self._compensate_depth_delay = DepthDelayCompensation(config, camera)
        self._compensate_rolling_shutter = RollingShutterCompensation(camera)

    @compiled_by(_compensate_compiled)
    def __call__(
        self, features: Features, depth: Tensor, depth_delay: float, velocity: Tensor, readout: Readout
    ) -> Features:
        """Compensate the features of a frame.

        Args:
            features: Features as observed, or compensated with the same readout and another velocity.
            depth: Depth image, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            depth_delay: Time of the depth image minus time of the colour image, seconds.
            velocity: Twist per second ``[m/s, rad/s]`` by which static points move in the camera frame, float64, shape
                :math:`(6,)`.
            readout: Readout of the camera.
        """
        features = self._compensate_depth_delay(features, depth, velocity, depth_delay)
        return self._compensate_rolling_shutter(features, velocity, readout)
