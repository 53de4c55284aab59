"""ORB feature detection (paper, Sec. III-A; Rublee et al., ICCV 2011)."""

from __future__ import annotations

import kornia_rs
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import FeaturesConfig
from v3d_torch.features import brief
from v3d_torch.features.brightness import brighten
from v3d_torch.features.corner_selection import select_corners
from v3d_torch.features.fast import detect_corners
from v3d_torch.features.features import Features, sample_depth
from v3d_torch.features.scale_pyramid import ScalePyramid, octaves_of_levels
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels.arrays import Ints

_THRESHOLD, _MIN_THRESHOLD = 20, 7
"""Minimum difference of brightness between a corner and its surroundings, grey levels; the lower threshold is used in
cells without other corners (ORB-SLAM2)."""

_CELL = 32
"""Side of these cells, pixels of the level (ORB-SLAM2 uses 30 or 35). The margin between two levels is wider."""

_SMOOTHING_SIZE, _SMOOTHING_SIGMA = (7, 7), (2.0, 2.0)
"""Kernel size and standard deviation of the Gaussian filter before the comparisons of BRIEF, pixels (OpenCV)."""


class ORB:
    """Detector and descriptor of ORB features.

    The ORB of kornia-rs is not used: it takes longer, selects several pixels of one corner, and finds no features on
    surfaces with little contrast.

    Args:
        config: Number of features, scale pyramid, maximum depth.
        camera: Camera of the images, whose model undistorts the features.
    """

    def __init__(self, config: FeaturesConfig, camera: PinholeCamera) -> None:
        self._camera = camera
        self._max_depth = config.max_depth
        octaves = octaves_of_levels(config, camera.width)
        self._first_octave = octaves[0]
        self._pyramid = ScalePyramid(camera.width, camera.height, octaves, config.scale, brief.MARGIN)
        # A geometric series, so that the density is the same on all levels.
        shares = config.scale ** -np.arange(len(self._pyramid.sizes), dtype=np.float64)
        self._counts = np.round(config.count * shares / shares.sum()).astype(int).tolist()

    def __call__(self, image: Tensor, depth: Tensor) -> Features:
        """Detect features in the whole image; masks are applied later, by `Features.in_mask`.

        A dark image is brightened first, see `brighten`.

        Args:
            image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.
            depth: Depth image, metres, shape :math:`(1, H, W)`; 0 = no measurement.

        Returns:
            Features with the depth of their nearest pixel.
        """
        pixels = brighten(image).permute(1, 2, 0).contiguous().numpy()
        grey = np.asarray(kornia_rs.imgproc.gray_from_rgb(pixels))[..., 0]
        canvas = self._pyramid.build(grey)
        corners, offsets, level = self._detect(canvas)
        smoothed = kornia_rs.imgproc.gaussian_blur(canvas[..., None], _SMOOTHING_SIZE, _SMOOTHING_SIGMA)[..., 0]
        descriptors = brief.describe(*map(torch.from_numpy, (canvas, smoothed, corners)))
        # Pixel centres lie at integers, so the image borders lie at half-integers.
        ratio = (self._camera.width, self._camera.height) / np.array(self._pyramid.sizes)
        corners[:, 1] -= self._pyramid.tops[level]
        position = torch.from_numpy((corners + offsets + 0.5) * ratio[level] - 0.5)
        pixel = position.round().to(torch.int64)
        return Features(
            uv=self._camera.undistort(position),
            pixel=pixel,
            depth=sample_depth(pixel, depth, self._max_depth),
            octave=torch.from_numpy(level + self._first_octave),
            descriptors=descriptors,
        )

    def _detect(self, canvas: NDArray[np.uint8]) -> tuple[Ints, NDArray[np.float64], Ints]:
        """Detect corners in the image of all levels.

        Returns:
            Corners (column, row), (N, 2), their offsets to a fraction of a pixel, (N, 2), and the level of each,
            sorted, (N,).
        """
        pyramid = self._pyramid
        corners, strength, offsets = detect_corners(canvas, pyramid.boxes, _THRESHOLD, _MIN_THRESHOLD, _CELL)
        level = pyramid.level_of_row[corners[:, 1]]
        in_level = corners - np.stack([np.zeros_like(level), pyramid.tops[level]], axis=1)
        selected = select_corners(in_level, strength, level, pyramid.sizes, self._counts)
        return corners[selected], offsets[selected], level[selected]
