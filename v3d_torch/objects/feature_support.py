"""Feature support of static objects: features on a static object fit the camera motion as well as other features.

A person whose motion is not known yet is masked. But a segmentation network also labels rotated furniture as people,
sometimes over most of the image, and then too few pixels remain for camera tracking. Features distinguish the two: few
features on a walking person fit the camera motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from v3d_torch.objects.feature_shift import FeatureShift, feature_shifts

_MIN_SUPPORT_RATIO = 0.5
"""Minimum inlier ratio of the features of a supported object, as a fraction of the inlier ratio outside of all objects:
on a static object both are similar, on a walking person nearly no feature is an inlier."""

_MIN_SUPPORTING_FEATURES = 10
"""Minimum number of inliers on a supported object: a few inliers can lie on the contour of an object in front of it."""

_MIN_OUTSIDE_FEATURES, _USUAL_INLIER_RATIO = 20, 0.5
"""With fewer features outside of all objects, their inlier ratio is not known. Then at least this usual ratio is
assumed: otherwise a few inliers on a person who fills the image would be enough."""


@dataclass(frozen=True)
class FeatureSupport:
    """Features of a frame and their agreement with the camera motion.

    Attributes:
        pixel: Pixel (column, row) of each feature, int64, shape :math:`(N, 2)`.
        inliers: Mask of the features that are matched to the previous frame and fit the camera motion, bool, shape
            :math:`(N,)`.
        residuals: Displacement of each feature against the camera motion, pixels, float64, shape :math:`(N, 2)`; NaN
            for features without a match.
    """

    pixel: Tensor
    inliers: Tensor
    residuals: Tensor

    def on_objects(self, masks: Sequence[Tensor]) -> Tensor:
        """Find the features on each object.

        Args:
            masks: Masks of K objects, bool, each of shape :math:`(H, W)`.

        Returns:
            Mask of the features of each object, bool, shape :math:`(K, N)`.
        """
        if len(masks) == 0:
            return self.inliers.new_zeros(0, len(self.pixel))
        # NumPy is faster here than torch.
        index = (self.pixel[:, 1] * masks[0].shape[1] + self.pixel[:, 0]).numpy()
        return torch.from_numpy(np.stack([mask.numpy().take(index) for mask in masks]))

    def supports(self, on_objects: Tensor) -> Tensor:
        """Find the objects whose features fit the camera motion.

        Args:
            on_objects: Features of each of K objects, see `on_objects`.

        Returns:
            Mask of the supported objects, bool, shape :math:`(K,)`.
        """
        outside = ~on_objects.any(dim=0)
        outside_ratio = (self.inliers & outside).sum() / outside.sum().clamp(min=1)
        if int(outside.sum()) < _MIN_OUTSIDE_FEATURES:
            outside_ratio = outside_ratio.clamp(min=_USUAL_INLIER_RATIO)
        counts, features = (on_objects & self.inliers).sum(dim=1), on_objects.sum(dim=1)
        return (counts >= _MIN_SUPPORTING_FEATURES) & (counts >= _MIN_SUPPORT_RATIO * outside_ratio * features)

    def have_most_inliers(self, on_objects: Tensor) -> Tensor:
        """Find the objects on which most of the features are that fit the camera motion.

        The motion was measured mainly from them, so that it shows no motion of the object itself.

        Args:
            on_objects: Features of each of K objects, see `on_objects`.

        Returns:
            Mask of these objects, bool, shape :math:`(K,)`.
        """
        counts = (on_objects & self.inliers).sum(dim=1)
        return (counts >= _MIN_SUPPORTING_FEATURES) & (2 * counts > self.inliers.sum())

    def shifts(self, on_objects: Tensor, size: Sequence[int]) -> list[FeatureShift | None]:
        """Measure how far the features on objects move together, see `feature_shifts`; None if this is not known.

        Args:
            on_objects: Features of each of K objects, see `on_objects`.
            size: Height and width of the image, pixels.
        """
        return feature_shifts(self.pixel, self.residuals, on_objects, size)
