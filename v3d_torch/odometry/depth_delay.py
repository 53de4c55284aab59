"""Depth that was measured at another time than colour was taken.

The two cameras of a Kinect run freely: of a colour image and the depth image next to it one is up to 20 ms the older
(Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012), in which a turn of 1 rad/s moves the
image by some 10 pixels. So the depth of a feature is read where the feature was when depth was measured, and put to the
time of colour.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.orb import Features, sample_depth
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.motion_field import motion_field


class DepthDelayCompensation:
    """Gives features the depth that they had at the time of the colour image.

    Args:
        config: whether, and how far depth counts.
        camera: of both images; their rows are taken for read at the same pace.
    """

    def __init__(self, config: Config, camera: PinholeCamera) -> None:
        self._enabled = config.rolling_shutter.enabled
        self._max_depth = config.features.max_depth
        self._camera = camera

    def __call__(self, features: Features, depth: Tensor, velocity: Tensor, delay: float) -> Features:
        """Features of a camera in motion.

        Args:
            features: of the colour image.
            depth: metres, shape :math:`(1, H, W)`, 0 = none.
            velocity: of the points in the camera, twist per second, float64, shape :math:`(6,)`.
            delay: of the depth image, seconds after the colour image.

        Returns:
            The same features with that depth; as they are, without a delay.
        """
        if not delay or not self._enabled:
            return features
        moves, rate = motion_field(features.uv, features.inverse_depth, velocity, self._camera)
        z = sample_depth((features.pixel + delay * moves).round().to(torch.int64), depth, self._max_depth)
        return replace(features, depth=torch.where(z > 0, z / (1 - delay * rate * z), 0.0))
