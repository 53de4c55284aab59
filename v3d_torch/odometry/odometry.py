"""The camera's motion since the last frame: from features (paper, Sec. III-E), where they fail from all pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.orb import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.odometry.dense_aligner import DenseAligner
from v3d_torch.odometry.dense_view import DenseView
from v3d_torch.odometry.motion_estimator import MotionEstimator, RelativeMotion
from v3d_torch.types import RGBDFrame


@dataclass(frozen=True)
class TrackedFrame:
    """What a frame saw, and what of it stood still.

    Attributes:
        frame: as it came.
        depth: re-estimated, metres, shape :math:`(1, H, W)`.
        features: of what stood still; of all, while that is not known.
        static: pixels that stood still, bool, shape :math:`(H, W)`; None while that is not known.
        landmarks: id of the landmark behind each feature, -1 for none, int64, shape :math:`(N,)`.
    """

    frame: RGBDFrame
    depth: Tensor
    features: Features
    static: Tensor | None = None
    landmarks: Tensor | None = None

    def matched(self, motion: RelativeMotion | None) -> Tensor:
        """Which features a motion to this view was seen on, bool, shape :math:`(N,)`; none where there is none."""
        matched = torch.zeros(len(self.features), dtype=torch.bool)
        if motion is not None:
            matched[motion.pairs[:, 1]] = True
        return matched

    def carried(self, motion: RelativeMotion | None, then: TrackedFrame | None) -> Tensor:
        """Ids of the landmarks that the motion's matches carry over from a view, -1 for none, :math:`(N,)`."""
        if motion is None or then is None or then.landmarks is None:
            return torch.full((len(self.features),), -1, dtype=torch.int64)
        return motion.propagate_landmarks(then.landmarks, len(self.features))


class Odometry:
    """Finds the motion between two frames.

    Args:
        config: of the whole system.
        camera: of the frames.
        by_features: registers two views by their features.
    """

    def __init__(self, config: Config, camera: PinholeCamera, by_features: MotionEstimator) -> None:
        self._config = config
        self._by_features = by_features
        self._align = DenseAligner(config.dense_odometry, camera)

    def __call__(self, then: TrackedFrame, now: TrackedFrame, T_ba: Tensor) -> RelativeMotion | None:
        """Motion of the camera from an earlier view to the newest one.

        Args:
            then: of which it is known what stood still.
            now: newest.
            T_ba: prediction, float64, shape :math:`(4, 4)`.

        Returns:
            None when neither features nor pixels tell, or what they tell is no motion that a camera can make.
        """
        elapsed = now.frame.stamp - then.frame.stamp
        motion = self._by_features(then.features, now.features, elapsed, T_ba)
        if motion is not None:
            return motion
        aligned = self._align(self._dense(then), self._dense(now), T_ba)
        if aligned is None:
            return None
        motion = RelativeMotion(aligned.T_ba, torch.zeros(0, 2, dtype=torch.int64))
        return motion if motion.is_plausible(elapsed, self._config.odometry) else None

    def _dense(self, view: TrackedFrame) -> DenseView:
        grey = rgb_to_grayscale(view.frame.image.to(torch.float32) / 255)
        everywhere = torch.ones(grey.shape[-2:], dtype=torch.bool)
        return self._align.view(grey, view.depth, everywhere if view.static is None else view.static)
