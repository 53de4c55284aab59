"""Compensation of the times at which the rows of colour and depth were read, for a moving camera."""

from __future__ import annotations

from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.odometry.depth_delay import DepthDelayCompensation
from v3d_torch.odometry.rolling_shutter import Readout, compensate_features, undo_compensation


class TimeCompensation:
    """Moves features to where a global shutter, with simultaneous depth, would have observed them.

    Args:
        config: Configuration of the whole system.
        camera: Camera of all frames.
    """

    def __init__(self, config: Config, camera: PinholeCamera) -> None:
        self._depth_delay = camera.depth_delay
        self._compensate_depth_delay = DepthDelayCompensation(config, camera)
        self._camera = camera

    def __call__(
        self, features: Features, depth: Tensor, depth_delay: float, velocity: Tensor, readout: Readout
    ) -> Features:
        """Compensate the features of a frame.

        Args:
            features: Features as observed, or compensated with the same readout and another velocity.
            depth: Depth image, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            depth_delay: Time of the depth image minus time of the colour image by their timestamps, seconds; the
                camera's own delay is added.
            velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, float64, shape
                :math:`(6,)`.
            readout: Readout of the camera.
        """
        observed = undo_compensation(features, readout)
        delayed = self._compensate_depth_delay(observed, depth, velocity, depth_delay + self._depth_delay)
        return compensate_features(delayed, velocity, readout, self._camera)
