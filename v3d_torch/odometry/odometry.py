"""Odometry: camera motion since the last frame, from features (paper, Sec. III-E) or, if they fail, from all pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.odometry.dense_aligner import DenseAligner
from v3d_torch.odometry.dense_view import DenseView
from v3d_torch.odometry.motion_estimator import MotionEstimator, RelativeMotion
from v3d_torch.types import RGBDFrame


@dataclass(frozen=True)
class TrackedFrame:
    """Observations of a frame, restricted to its static pixels as soon as these are known.

    Attributes:
        frame: The frame as it was recorded.
        depth: Re-estimated depth, metres, shape :math:`(1, H, W)`.
        features: Features on static pixels; all features while the static pixels are unknown.
        static_mask: Mask of the static pixels, bool, shape :math:`(H, W)`; None while unknown.
        landmark_ids: Landmark id of each feature, int64, shape :math:`(N,)`, -1 = none; None while unknown.
    """

    frame: RGBDFrame
    depth: Tensor
    features: Features
    static: Tensor | None = None
    landmarks: Tensor | None = None

    def matched(self, motion: RelativeMotion | None) -> Tensor:
        """Mask of the features that are inliers of a motion to this frame.

        Args:
            motion: Motion from another frame to this one; None if it is unknown.

        Returns:
            Bool, shape :math:`(N,)`; all false without a motion.
        """
        mask = torch.zeros(len(self.features), dtype=torch.bool)
        if motion is not None:
            mask[motion.pairs[:, 1]] = True
        return mask

    def carried(self, motion: RelativeMotion | None, previous: TrackedFrame | None) -> Tensor:
        """Landmark ids of the features, propagated from another frame by the matches of a motion.

        Args:
            motion: Motion from the other frame to this one; None if it is unknown.
            previous: The other frame; None if there is none.

        Returns:
            Landmark id of each feature, int64, shape :math:`(N,)`; -1 = none.
        """
        if motion is None or previous is None or previous.landmarks is None:
            return torch.full((len(self.features),), -1, dtype=torch.int64)
        return motion.propagate_landmarks(previous.landmarks, len(self.features))


class Odometry:
    """Estimates the camera motion between two frames: features first, dense alignment if they fail.

    Args:
        config: Configuration of the whole system.
        camera: Intrinsics.
        estimate_motion: Registration of two views by their features.
    """

    def __init__(self, config: Config, camera: PinholeCamera, estimate_motion: MotionEstimator) -> None:
        self._max_speed = config.odometry.max_speed
        self._estimate_motion = estimate_motion
        self._align = DenseAligner(config.dense_odometry, camera)

    def __call__(self, previous: TrackedFrame, current: TrackedFrame, T_ba: Tensor) -> RelativeMotion | None:
        """Estimate the motion from an earlier frame "a" to the newest frame "b".

        Args:
            previous: Earlier frame, whose static pixels are known.
            current: Newest frame.
            T_ba: Predicted motion, float64, shape :math:`(4, 4)`.

        Returns:
            None if neither features nor dense alignment give a plausible motion.
        """
        elapsed = current.frame.stamp - previous.frame.stamp
        motion = self._estimate_motion(previous.features, current.features, elapsed, T_ba)
        if motion is not None:
            return motion
        alignment = self._align(self._dense_view(previous), self._dense_view(current), T_ba)
        if alignment is None:
            return None
        motion = RelativeMotion(alignment.T_ba, torch.zeros(0, 2, dtype=torch.int64))
        return motion if motion.is_plausible(elapsed, self._max_speed) else None

    def _dense_view(self, tracked: TrackedFrame) -> DenseView:
        grey = rgb_to_grayscale(tracked.frame.image.to(torch.float32) / 255)
        all_pixels = torch.ones(grey.shape[-2:], dtype=torch.bool)
        return self._align.view(grey, tracked.depth, all_pixels if tracked.static is None else tracked.static)
