"""Depth-delay compensation: the depth image was taken at another time than the colour image.

The colour and depth cameras of many RGB-D sensors are not synchronised; the images of a pair are up to half a frame
period apart (Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012). In this time, a moving
camera shifts the image by several pixels. The depth of a feature is therefore sampled where the feature was at the time
of the depth image, and converted to the depth at the time of the colour image.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features, sample_depth
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.motion_field import motion_field
from v3d_torch.kernels import time_compensation as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array


def _compensate_compiled(
    self: DepthDelayCompensation, features: Features, depth: Tensor, velocity: Tensor, delay: float
) -> Features:
    if not delay or not self._enabled:
        return features
    if depth.dtype != torch.float32 or velocity.dtype != torch.float64 or features.uv.requires_grad:
        return NotImplemented
    camera = self._camera
    new_depth = kernels.compensate_depth_delay(
        to_array(features.uv),
        to_array(features.pixel),
        to_array(depth[0]),
        to_array(velocity),
        delay,
        self._max_depth,
        (camera.fx, camera.fy, camera.cx, camera.cy),
    )
    return replace(features, depth=torch.from_numpy(new_depth))


class DepthDelayCompensation:
    """Computes the depth of features at the time of the colour image.

    Args:
        config: Configuration of the whole system: whether compensation is enabled, maximum depth.
        camera: Intrinsics of both images. The rows of both are assumed to be read at the same rate.
    """

    def __init__(self, config: Config, camera: PinholeCamera) -> None:
        self._enabled = config.rolling_shutter.enabled
        self._max_depth = config.features.max_depth
        self._camera = camera

    @compiled_by(_compensate_compiled)
    def __call__(self, features: Features, depth: Tensor, velocity: Tensor, delay: float) -> Features:
        r"""Sample the depth of features at the time of the depth image, and convert it to the time of the colour image.

        A feature moves between the images with the depth at its pixel. With delay :math:`\tau`, the depth :math:`z`
        where it moves to, and the rate :math:`\dot w` of its inverse by the motion field, the depth at the time of the
        colour image is :math:`z / (1 - \tau \dot w z)`. Beside a depth edge, both depths can be those of different
        surfaces. The depth that the features had before is not used.

        Args:
            features: Features of the colour image, where they were observed.
            depth: Depth image, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, float64, shape
                :math:`(6,)`.
            delay: Time of the depth image minus time of the colour image, seconds, including the delay that the camera
                adds to the difference of their timestamps.

        Returns:
            The features with the new depth; the same object if there is no delay or compensation is disabled.
        """
        if not delay or not self._enabled:
            return features
        z = sample_depth(features.pixel, depth, self._max_depth)
        pixel_velocity, _ = motion_field(features.uv, _invert(z), velocity, self._camera.K)
        shifted = (features.pixel + delay * pixel_velocity).round().to(torch.int64)
        z = sample_depth(shifted, depth, self._max_depth)
        _, rate = motion_field(features.uv, _invert(z), velocity, self._camera.K)
        return replace(features, depth=torch.where(z > 0, z / (1 - delay * rate * z), 0.0))


def _invert(z: Tensor) -> Tensor:
    """Return the inverse of depths; 0 for those that are not measured."""
    return torch.where(z > 0, 1 / z, 0.0)
