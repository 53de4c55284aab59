"""Typed protocols of the stages that are functions of their input, for stages of your own.

A type checker compares a class or function with the protocol of its stage: ``stage: OdometryStage = MyOdometry()``.
Arguments are passed by position, so that their names are free. The protocol of the segmenter is `Segmenter`.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.odometry.odometry import CameraMotion, TrackedFrame
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.types import Instances


class DepthStage(Protocol):
    """Depth re-estimation, such as `DepthSmoother`; attribute ``smooth_depth``."""

    def __call__(self, depth: Tensor, /) -> Tensor:
        """Re-estimate depth images.

        Args:
            depth: Depth, metres, float32, shape :math:`(B, 1, H, W)`; 0 = no measurement.

        Returns:
            Depth of the same shape and dtype.
        """


class FeatureStage(Protocol):
    """Detector of features, such as `ORB`; attribute ``detect_features``."""

    def __call__(self, image: Tensor, depth: Tensor, /) -> Features:
        """Detect features.

        Args:
            image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.
            depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        """


class CompensationStage(Protocol):
    """Compensation of rolling shutter and depth delay, such as `TimeCompensation`; attribute ``compensate``."""

    def __call__(
        self, features: Features, depth: Tensor, depth_delay: float, velocity: Tensor, readout: Readout, /
    ) -> Features:
        """Move features to where a global shutter would observe them, with their depth at that time.

        Args:
            features: Features as observed, or compensated with the same readout and another velocity: the result must
                be the same.
            depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
            depth_delay: Time of the depth image minus time of the colour image by their timestamps, seconds; the
                camera's own delay, `PinholeCamera.depth_delay`, is to be added.
            velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, float64, shape
                :math:`(6,)`.
            readout: Readout of the camera.

        Returns:
            As many features in the same order.
        """


class OdometryStage(Protocol):
    """Motion of the camera between two frames, such as `Odometry`; attribute ``odometry``."""

    def __call__(
        self, previous: TrackedFrame | None, current: TrackedFrame, T_cp: Tensor, velocity: Tensor, /
    ) -> CameraMotion:
        """Estimate the motion of the camera since the previous frame.

        Args:
            previous: Previous frame, whose static pixels are known; None for the first frame.
            current: Current frame.
            T_cp: Predicted motion, maps points from the previous camera to the current one, float64, shape
                :math:`(4, 4)`.
            velocity: Predicted velocity, see `CameraMotion`, float64, shape :math:`(6,)`.
        """


class ProposalStage(Protocol):
    """Proposal of moving regions without a class, such as `unlabelled_instances`; attribute ``propose_unlabelled``."""

    def __call__(self, appeared_pixels: AppearedPixels, instances: Instances, depth: Tensor, /) -> Instances:
        """Propose regions that move and that no given instance contains.

        Args:
            appeared_pixels: Pixels of the frame that appeared.
            instances: Instances of the frame, from the segmenter or propagated from the previous frame.
            depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.

        Returns:
            Further instances.
        """


class BackProjectionStage(Protocol):
    """Clouds of instances, such as `InstanceBackProjector`; attribute ``back_project_instances``."""

    def __call__(self, depth: Tensor, instances: Instances, /) -> InstanceClouds:
        """Back-project instances to clouds in the camera frame.

        Args:
            depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
            instances: Instances of the same image.

        Returns:
            Clouds in the order of the instances.
        """


class AppearanceStage(Protocol):
    """Appearance of instances, such as `colour_histograms`; attribute ``describe_appearance``."""

    def __call__(self, image: Tensor, masks: Tensor, /) -> Tensor:
        """Describe instances by vectors that are similar for the same object in other frames.

        Args:
            image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.
            masks: Pixels of N instances, bool, shape :math:`(N, H, W)`.

        Returns:
            Vectors of any length D, non-negative with sum 1, float32, shape :math:`(N, D)`; NaN for an instance that
            cannot be described.
        """
