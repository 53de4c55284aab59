"""Colour encodings of ROS and librealsense, and their conversion to RGB."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

COLOUR_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "y8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUYV),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUYV),
}
"""Bytes per pixel of each supported encoding, and the OpenCV code that converts it to RGB (None: already RGB)."""


def convert_to_rgb(encoding: str, pixels: NDArray[Any]) -> Tensor:
    """Convert an 8-bit colour image to an RGB tensor.

    Args:
        encoding: Key of `COLOUR_ENCODINGS`.
        pixels: Encoded image, uint8, shape (H, W, C) or (H, W).

    Returns:
        RGB image, uint8, shape :math:`(3, H, W)`; never shares memory with ``pixels``.
    """
    conversion = COLOUR_ENCODINGS[encoding][1]
    rgb = pixels.copy() if conversion is None else cv2.cvtColor(pixels, conversion)
    return torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1)
