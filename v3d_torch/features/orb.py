"""ORB feature detection (paper, Sec. III-A; Rublee et al., ICCV 2011)."""

from __future__ import annotations

import kornia_rs
import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig
from v3d_torch.features.features import Features, sample_depth
from v3d_torch.geometry.camera import PinholeCamera


class ORB:
    """Detector and descriptor of ORB features, by kornia-rs.

    Args:
        config: Number of features, scale pyramid, maximum depth.
        camera: Camera of the images; undistorts the features.
    """

    def __init__(self, config: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera

    def __call__(self, image: Tensor, depth: Tensor) -> Features:
        """Detect features in the whole image; masks are applied later, by `Features.in_mask`.

        Args:
            image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.
            depth: Depth image, metres, shape :math:`(1, H, W)`; 0 = no measurement.

        Returns:
            Features with the depth of their nearest pixel.
        """
        detected = kornia_rs.features.orb_detect_and_compute(
            image.permute(1, 2, 0).contiguous().numpy(),
            n_keypoints=self._config.count,
            n_scales=self._config.levels,
            downscale=self._config.scale,
        )
        height, width = image.shape[-2:]
        position = torch.from_numpy(detected.keypoints_xy.copy()).to(torch.float64).reshape(-1, 2)
        pixel = position.round().to(torch.int64)
        pixel = torch.stack([pixel[:, 0].clamp(0, width - 1), pixel[:, 1].clamp(0, height - 1)], dim=1)
        return Features(
            uv=self._camera.undistort(position),
            pixel=pixel,
            depth=sample_depth(pixel, depth, self._config.max_depth),
            octave=torch.from_numpy(detected.octaves.astype("int64")),
            descriptors=torch.from_numpy(detected.descriptors.copy()).reshape(-1, 32),
        )
