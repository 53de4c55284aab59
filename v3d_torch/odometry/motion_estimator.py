"""Registration of two images by features: matching, epipolar RANSAC, PnP-RANSAC with depth (paper, Sec. III-E)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, OdometryConfig
from v3d_torch.features.features import Features, select_evenly
from v3d_torch.features.fundamental_ransac import epipolar_inliers
from v3d_torch.features.matching import match_descriptors
from v3d_torch.features.pnp_ransac import pnp_ransac
from v3d_torch.features.scale_pyramid import octaves_of_levels
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_log, transform_points
from v3d_torch.types import MIN_INTERVAL

_EPIPOLAR_THRESHOLD = 2.0
"""Maximum Sampson distance of epipolar inliers, pixels of the finest level: twice the localisation error of a
feature."""

_PNP_THRESHOLD = 4.0
"""Maximum reprojection error of inliers of PnP-RANSAC, pixels of the finest level. Larger than the epipolar threshold,
because the depth error of the points adds to the pixel error."""

_MAX_ROTATION_RATE = 6.3
"""Maximum rotation rate of a handheld camera or of a camera on a robot, rad/s: a full turn in a second."""


_MAX_DEPTH_RATIO = 1.2
"""Maximum of the median ratio of measured depth to that of the matched points; its inverse is the minimum. The depth
noise at 6 m is a tenth of this."""

_MIN_MEASURED = 10
"""Minimum number of matches with depth for a comparison."""


def no_matches() -> Tensor:
    """Return an empty list of matches, int64, shape (0, 2)."""
    return torch.zeros(0, 2, dtype=torch.int64)


@dataclass(frozen=True)
class RelativeMotion:
    """Rigid motion of the camera from view "a" to view "b".

    Attributes:
        T_ba: Maps points from camera a to camera b, float64, shape :math:`(4, 4)`.
        inlier_matches: Inliers (feature of a, feature of b), int64, shape :math:`(K, 2)`; K = 0 for a motion found by
            dense alignment.
        matches: All matches by descriptors, inliers and outliers (feature of a, feature of b), int64, shape
            :math:`(M, 2)`.
    """

    T_ba: Tensor
    inlier_matches: Tensor
    matches: Tensor = field(default_factory=no_matches, kw_only=True)

    @cached_property
    def xi(self) -> Tensor:
        """Logarithm of ``T_ba``, ``[translation, rotation]``, metres and radians, float64, shape :math:`(6,)`."""
        return se3_log(self.T_ba)

    def velocity(self, elapsed: float) -> Tensor:
        """Mean twist of static points in the camera frame.

        Args:
            elapsed: Time between the views, seconds; at least `MIN_INTERVAL` is assumed.

        Returns:
            Twist ``[m/s, rad/s]``, float64, shape :math:`(6,)`.
        """
        return self.xi / max(elapsed, MIN_INTERVAL)

    def is_plausible(self, elapsed: float, max_speed: float) -> bool:
        """Check whether a handheld camera or a camera on a robot can move this fast.

        Args:
            elapsed: Time between the views, seconds; at least `MIN_INTERVAL` is assumed.
            max_speed: Maximum speed of a camera, m/s.
        """
        elapsed = max(elapsed, MIN_INTERVAL)
        distance, angle = float(self.xi[:3].norm()), float(self.xi[3:].norm())
        return distance <= max_speed * elapsed and angle <= _MAX_ROTATION_RATE * elapsed


def propagate_landmarks(matches: Tensor, landmarks: Tensor, count: int) -> Tensor:
    """Landmark ids of the features of view b, propagated from view a by matches.

    Args:
        matches: Matches (feature of a, feature of b), int64, shape :math:`(K, 2)`.
        landmarks: Landmark id of each feature of a, int64, shape :math:`(N,)`; -1 = none.
        count: Number of features of b.

    Returns:
        Landmark id of each feature of b, int64, shape ``(count,)``; -1 = none.
    """
    propagated = torch.full((count,), -1, dtype=torch.int64)
    propagated[matches[:, 1]] = landmarks[matches[:, 0]]
    return propagated


class MotionEstimator:
    """Estimates the camera motion between two views from their features.

    Args:
        config: Thresholds of matching and RANSAC.
        features_config: Grid over which the features are spread, and scale pyramid.
        camera: Intrinsics.
        seed: Seed of both RANSACs.
    """

    def __init__(
        self, config: OdometryConfig, features_config: FeaturesConfig, camera: PinholeCamera, seed: int
    ) -> None:
        self._config = config
        self._cell = features_config.cell
        self._finest_pixel = features_config.scale ** octaves_of_levels(features_config, camera.width)[0]
        self._camera = camera
        self._seed = seed

    def __call__(
        self, a: Features, b: Features, elapsed: float = math.inf, initial_guess: Tensor | None = None
    ) -> RelativeMotion | None:
        """Estimate the motion from view a to view b.

        Args:
            a: Features of the earlier view; only those with depth are used.
            b: Features of the later view.
            elapsed: Time between the views, seconds; bounds the plausible motion.
            initial_guess: Predicted ``T_ba``, float64, shape :math:`(4, 4)`; None if unknown, as in loop detection.
                Without a prediction all features of a are matched, because b is expected to observe only few of them.

        Returns:
            None if fewer than ``min_inliers`` matches agree on a motion, or if the motion is not plausible; without a
            prediction also if the depth of b is not that of the points of a.
        """
        config = self._config
        selected = torch.nonzero(a.depth > 0)[:, 0]
        if initial_guess is not None:
            selected = selected[select_evenly(a.pixel[selected], config.max_features, self._cell)]
        match_of_feature = match_descriptors(
            a.descriptors[selected], b.descriptors, max_hamming=config.max_hamming, max_ratio=config.max_ratio
        )
        matched = torch.nonzero(match_of_feature >= 0)[:, 0]
        pairs = matches = torch.stack([selected[matched], match_of_feature[matched]], dim=1)
        if pairs.shape[0] < config.min_inliers:
            return None
        epipolar = epipolar_inliers(
            a.uv[pairs[:, 0]],
            b.uv[pairs[:, 1]],
            threshold=_EPIPOLAR_THRESHOLD * self._finest_pixel,
            iterations=config.iterations,
            seed=self._seed,
        )
        pairs = pairs[epipolar]
        if pairs.shape[0] < config.min_inliers:
            return None
        points = self._camera.back_project(a.uv[pairs[:, 0]], a.depth[pairs[:, 0]])
        pose = pnp_ransac(
            points,
            b.uv[pairs[:, 1]],
            self._camera.K,
            initial_guess,
            threshold=_PNP_THRESHOLD * self._finest_pixel,
            iterations=config.iterations,
            seed=self._seed,
        )
        if int(pose.inliers.sum()) < config.min_inliers:
            return None
        inliers = pairs[pose.inliers]
        if initial_guess is None and not _agrees_in_depth(pose.T_cw, points[pose.inliers], b.depth[inliers[:, 1]]):
            return None
        motion = RelativeMotion(pose.T_cw, inliers, matches=matches)
        return motion if motion.is_plausible(elapsed, config.max_speed) else None


def _agrees_in_depth(T_ba: Tensor, points: Tensor, depth: Tensor) -> bool:
    """Check whether the measured depth in b is that of the matched points: that of a wrong scale or place is not.

    Args:
        T_ba: Motion, float64, shape (4, 4).
        points: Points in camera a, metres, float64, shape (K, 3).
        depth: Depth of their features in b, metres, float64, shape (K,); 0 = no measurement.
    """
    measured = depth > 0
    if int(measured.sum()) < _MIN_MEASURED:
        return True
    ratio = float((depth / transform_points(T_ba, points)[:, 2])[measured].median())
    return 1 / _MAX_DEPTH_RATIO < ratio < _MAX_DEPTH_RATIO
