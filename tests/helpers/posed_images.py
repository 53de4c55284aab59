"""Images of a coloured scene with known poses, for tests of exports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.export.posed_image import PosedImage
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.types import RGBDFrame

CAMERA = PinholeCamera(100.0, 105.0, 79.0, 58.5, 160, 120)
DISTORTED = replace(CAMERA, distortion=(0.26, -0.95, -0.005, 0.003, 1.16))
"""Lens distortion of TUM's freiburg1."""

FISHEYE = replace(CAMERA, distortion=(0.03, -0.01, 0.004, -0.002), distortion_model="equidistant")
RATIONAL = replace(CAMERA, distortion=(0.2, -0.1, 0.001, -0.001, 0.02, 0.5, -0.2, 0.01))

T_WC = se3_exp(torch.tensor([[0.0] * 6, [0.1, -0.05, 0.05, 0.02, -0.03, 0.1]], dtype=torch.float64))
"""Poses of two cameras that see the points."""

POINTS = torch.tensor(
    [[-0.6, 0.5, 1.9], [0.8, -0.4, 1.8], [0.2, 0.6, 2.2], [1.2, 0.7, 2.5], [-1.0, -0.6, 2.0]], dtype=torch.float64
)
"""World points, apart from each other in both images. The last one moves."""

COLOURS = np.array([[255, 0, 255], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255, 0, 0]], np.uint8)


def draw_points(camera: PinholeCamera, T_wc: Tensor) -> tuple[Tensor, Tensor]:
    """Draw a square of 5 x 5 pixels at each point with its colour and depth; return image and depth."""
    T_cw = invert(T_wc)
    points = POINTS @ T_cw[:3, :3].T + T_cw[:3, 3]
    pixels = camera.distort(camera.project(points)).round().to(torch.int64)
    image = np.full((camera.height, camera.width, 3), 40, np.uint8)
    depth = np.full((camera.height, camera.width), 3.0, np.float32)
    for (u, v), z, colour in zip(pixels.tolist(), points[:, 2].tolist(), COLOURS.tolist(), strict=True):
        cv2.rectangle(image, (u - 2, v - 2), (u + 2, v + 2), colour, -1)
        cv2.rectangle(depth, (u - 2, v - 2), (u + 2, v + 2), z, -1)
    return torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(depth)[None]


def posed_images(camera: PinholeCamera = CAMERA, poses: Sequence[Tensor] = tuple(T_WC)) -> list[PosedImage]:
    """Images of all points; the left quarter shows something that moves."""
    static = torch.ones(camera.height, camera.width, dtype=torch.bool)
    static[:, : camera.width // 4] = False
    return [
        PosedImage(RGBDFrame(10 * i, i / 10, *draw_points(camera, T_wc), camera=camera), T_wc, static)
        for i, T_wc in enumerate(poses)
    ]
