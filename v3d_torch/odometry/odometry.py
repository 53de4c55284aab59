"""Odometry: camera motion since the last frame, from features (paper, Sec. III-E) or, if they fail, from all pixels."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.odometry.dense_aligner import DenseAligner
from v3d_torch.odometry.dense_view import DenseView
from v3d_torch.odometry.motion_estimator import MotionEstimator, RelativeMotion, no_matches, propagate_landmarks
from v3d_torch.types import RGBDFrame


@dataclass(frozen=True)
class TrackedFrame:
    """Observations of a frame, restricted to its static pixels once these are known.

    Attributes:
        frame: The frame as it was recorded.
        depth: Re-estimated depth, metres, shape :math:`(1, H, W)`.
        features: Features on static pixels; all features while the static pixels are unknown.
        static_mask: Mask of the static pixels, bool, shape :math:`(H, W)`; None while unknown.
        landmarks: Landmark id of each feature, int64, shape :math:`(N,)`, -1 = none; None while unknown.
    """

    frame: RGBDFrame
    depth: Tensor
    features: Features
    static_mask: Tensor | None = None
    landmarks: Tensor | None = None


@dataclass(frozen=True)
class CameraMotion:
    """Motion of the camera since the previous frame.

    Attributes:
        T_cp: Maps points from the previous camera to the current one, float64, shape :math:`(4, 4)`.
        velocity: ``se3_log(T_cp)`` divided by the time, ``[m/s, rad/s]``, float64, shape :math:`(6,)`: the velocity of
            static points in the camera frame. `CameraState.twist`, that of the camera, has the opposite sign.
        inlier_matches: Inliers (feature of the previous frame, feature of the current frame), int64, shape
            :math:`(K, 2)`; K = 0 for a motion found by dense alignment, and for a prediction.
        is_measured: True if the motion was estimated from both frames, False if it is only predicted.
        matches: All matches by descriptors, inliers and outliers, in the same form, shape :math:`(M, 2)`. Slow
            motions of objects are measured from them; without them they are not found by features.
    """

    T_cp: Tensor
    velocity: Tensor
    inlier_matches: Tensor
    is_measured: bool
    matches: Tensor = field(default_factory=no_matches, kw_only=True)

    def inlier_mask(self, count: int) -> Tensor:
        """Mask of the features of the current frame that are inliers, bool, shape ``(count,)``."""
        mask = torch.zeros(count, dtype=torch.bool)
        mask[self.inlier_matches[:, 1]] = True
        return mask

    def residuals(self, previous: TrackedFrame | None, features: Features, camera: PinholeCamera) -> Tensor:
        """Difference of the matched features from where they would be if the scene stood still.

        Args:
            previous: Previous frame; None if there is none.
            features: N features of the current frame.
            camera: Camera of both frames.

        Returns:
            Measured minus expected position, pixels, float64, shape :math:`(N, 2)`; NaN for features without a match.
        """
        residuals = torch.full((len(features), 2), torch.nan, dtype=torch.float64)
        if previous is not None and len(self.matches):
            before, now = self.matches.unbind(dim=1)
            points = camera.back_project(previous.features.uv[before], previous.features.depth[before])
            expected = camera.project(transform_points(self.T_cp, points))
            residuals[now] = features.uv[now] - expected
        return residuals

    def propagate_landmarks(self, previous: TrackedFrame | None, count: int) -> Tensor:
        """Landmark ids of the features of the current frame, propagated by the inlier matches.

        Args:
            previous: Previous frame; None if there is none.
            count: Number of features of the current frame.

        Returns:
            Landmark id of each feature, int64, shape ``(count,)``; -1 = none.
        """
        if previous is None or previous.landmarks is None:
            return torch.full((count,), -1, dtype=torch.int64)
        return propagate_landmarks(self.inlier_matches, previous.landmarks, count)


class Odometry:
    """Estimates the camera motion between two frames: from features, or by dense alignment if features fail.

    Args:
        config: Configuration of the whole system.
        camera: Intrinsics.
        estimate_motion: Registration of two views by their features.
    """

    def __init__(self, config: Config, camera: PinholeCamera, estimate_motion: MotionEstimator) -> None:
        self._max_speed = config.odometry.max_speed
        self._estimate_motion = estimate_motion
        self._align = DenseAligner(config.dense_odometry, camera)

    def __call__(
        self, previous: TrackedFrame | None, current: TrackedFrame, T_cp: Tensor, velocity: Tensor
    ) -> CameraMotion:
        """Estimate the motion since the previous frame.

        Args:
            previous: Previous frame, whose static pixels are known; None for the first frame.
            current: Current frame.
            T_cp: Predicted motion, float64, shape :math:`(4, 4)`.
            velocity: Predicted velocity, see `CameraMotion`, float64, shape :math:`(6,)`.

        Returns:
            The prediction if neither features nor dense alignment give a plausible motion.
        """
        motion = None if previous is None else self.register(previous, current, T_cp)
        if previous is None or motion is None:
            return CameraMotion(T_cp, velocity, no_matches(), is_measured=False)
        elapsed = current.frame.stamp - previous.frame.stamp
        velocity = motion.velocity(elapsed)
        return CameraMotion(motion.T_ba, velocity, motion.inlier_matches, is_measured=True, matches=motion.matches)

    def register(self, previous: TrackedFrame, current: TrackedFrame, T_ba: Tensor) -> RelativeMotion | None:
        """Register two frames: the motion from an earlier frame "a" to a later frame "b".

        Args:
            previous: Earlier frame, whose static pixels are known.
            current: Later frame.
            T_ba: Predicted motion, float64, shape :math:`(4, 4)`.

        Returns:
            None if neither features nor dense alignment give a plausible motion.
        """
        elapsed = current.frame.stamp - previous.frame.stamp
        motion = self._estimate_motion(previous.features, current.features, elapsed, T_ba)
        if motion is not None:
            return motion
        alignment = self._align.align_views(self._dense_view(previous), self._dense_view(current), T_ba)
        if alignment is None:
            return None
        motion = RelativeMotion(alignment.T_ba, no_matches())
        return motion if motion.is_plausible(elapsed, self._max_speed) else None

    def _dense_view(self, tracked: TrackedFrame) -> DenseView:
        grey = rgb_to_grayscale(tracked.frame.image.to(torch.float32) / 255)
        all_pixels = torch.ones(grey.shape[-2:], dtype=torch.bool)
        return self._align.view(grey, tracked.depth, all_pixels if tracked.static_mask is None else tracked.static_mask)
