"""Warp of colour images to the depth camera, for recordings with two cameras at the same position."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def warp_colour(
    colour: Tensor, K_colour: NDArray[np.float64], K_depth: NDArray[np.float64], size: tuple[int, int]
) -> Tensor:
    """Warp a colour image to the depth camera, so that the pixels of both images have the same rays.

    Args:
        colour: Colour image, uint8, shape :math:`(3, H, W)`.
        K_colour: Camera matrix of the colour image, shape (3, 3).
        K_depth: Camera matrix of the depth image, shape (3, 3).
        size: Width and height of the depth image.

    Returns:
        Colour image of the depth camera, uint8, shape :math:`(3, H', W')` with the given size.
    """
    height, width = colour.shape[1:]
    # First average down to about the depth resolution, to avoid aliasing of fine texture. Then warp by fractions of
    # a pixel.
    shrink = K_depth.diagonal()[:2] / K_colour.diagonal()[:2]
    small_size = np.maximum(np.rint(np.array([width, height]) * shrink), 1).astype(int).tolist()
    small = cv2.resize(colour.permute(1, 2, 0).numpy(), small_size, interpolation=cv2.INTER_AREA)
    K_small = scale_matrix(K_colour, small_size[0] / width, small_size[1] / height)
    small_from_depth = (K_small @ np.linalg.inv(K_depth))[:2]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    pixels = cv2.warpAffine(small, small_from_depth, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(pixels).permute(2, 0, 1)


def scale_matrix(K: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """Scale a camera matrix to a resized image. Pixel centres are at integers, so the image begins at -0.5.

    Args:
        K: Camera matrix, shape (3, 3) or (4, 4).
        x: Factor of the width.
        y: Factor of the height.

    Returns:
        Camera matrix of the resized image, shape (3, 3).
    """
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return np.diag([x, y, 1.0]) @ (K[:3, :3] + half) - half
