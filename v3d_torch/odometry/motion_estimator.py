"""Camera motion between two frames: match, epipolar RANSAC, PnP-RANSAC with depth (paper, Sec. III-E)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, OdometryConfig
from v3d_torch.features.matching import match_descriptors
from v3d_torch.features.orb import Features, select_evenly
from v3d_torch.features.ransac import epipolar_inliers, pnp_ransac
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_log


@dataclass(frozen=True)
class RelativeMotion:
    """Rigid motion of the camera between a known view "a" and a new view "b".

    Attributes:
        T_ba: maps points of camera a to camera b, float64, shape :math:`(4, 4)`.
        pairs: inlier matches (feature of a, feature of b), int64, shape :math:`(K, 2)`; none where pixels told it.
    """

    T_ba: Tensor
    pairs: Tensor

    @cached_property
    def twist(self) -> Tensor:
        """Logarithm of ``T_ba``, float64, shape :math:`(6,)`."""
        return se3_log(self.T_ba)

    def velocity(self, elapsed: float) -> Tensor:
        """Mean twist per second over the time between the views, in seconds, float64, shape :math:`(6,)`."""
        return self.twist / elapsed

    def is_plausible(self, elapsed: float, config: OdometryConfig) -> bool:
        """Whether a camera in a hand or on a robot can move so in the time, given in seconds."""
        distance, angle = float(self.twist[:3].norm()), float(self.twist[3:].norm())
        return distance <= config.max_speed * elapsed and angle <= config.max_rotation_rate * elapsed

    def propagate_landmarks(self, landmarks: Tensor, count: int) -> Tensor:
        """Ids of the landmarks behind the features of b that the matches carry over from a.

        Args:
            landmarks: id of the landmark behind each feature of a, -1 for none, int64, shape :math:`(N,)`.
            count: of the features of b.

        Returns:
            -1 where there is none, int64, shape ``(count,)``.
        """
        carried = torch.full((count,), -1, dtype=torch.int64)
        carried[self.pairs[:, 1]] = landmarks[self.pairs[:, 0]]
        return carried


class MotionEstimator:
    """Estimates the camera's motion from features that stand still.

    Args:
        config: thresholds of matching and RANSAC.
        features: grid of the features.
        camera: gives ``K``.
        seed: of both RANSACs.
    """

    def __init__(self, config: OdometryConfig, features: FeaturesConfig, camera: PinholeCamera, seed: int) -> None:
        self._config = config
        self._cell = features.cell
        self._camera = camera
        self._seed = seed

    def __call__(
        self, a: Features, b: Features, elapsed: float = math.inf, guess: Tensor | None = None
    ) -> RelativeMotion | None:
        """Motion from view ``a`` to view ``b``.

        Args:
            a: known view; its features with depth take part.
            b: new view.
            elapsed: time between the views, seconds, which bounds how far a camera can have come.
            guess: motion that the camera may have made, ``T_ba``, float64, shape :math:`(4, 4)`; None if unknown, as
                where a place is seen again: then all features are matched, of which few show the same.

        Returns:
            None when fewer than ``min_inliers`` matches agree on one motion, or on one that no hand can make.
        """
        config = self._config
        chosen = torch.nonzero(a.depth > 0)[:, 0]
        if guess is not None:
            chosen = chosen[select_evenly(a.pixel[chosen], config.max_features, self._cell)]
        pairs = match_descriptors(
            a.descriptors[chosen], b.descriptors, max_hamming=config.max_hamming, max_ratio=config.max_ratio
        )
        pairs = torch.stack([chosen[pairs[:, 0]], pairs[:, 1]], dim=1)
        if pairs.shape[0] < config.min_inliers:
            return None
        epipolar = epipolar_inliers(
            a.uv[pairs[:, 0]],
            b.uv[pairs[:, 1]],
            threshold=config.epipolar_threshold,
            iterations=config.iterations,
            seed=self._seed,
        )
        pairs = pairs[epipolar]
        if pairs.shape[0] < config.min_inliers:
            return None
        pose = pnp_ransac(
            self._camera.back_project(a.uv[pairs[:, 0]], a.depth[pairs[:, 0]]),
            b.uv[pairs[:, 1]],
            self._camera,
            threshold=config.pnp_threshold,
            iterations=config.iterations,
            seed=self._seed,
            guess=guess,
        )
        if pose is None or int(pose[1].sum()) < config.min_inliers:
            return None
        T_ba, inliers = pose
        motion = RelativeMotion(T_ba, pairs[inliers])
        return motion if motion.is_plausible(elapsed, config) else None
