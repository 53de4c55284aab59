"""Depth edges and colour gradients of a view, to measure the registration of depth and colour."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.geometry.pixel_scale import pixel_scale

_EDGE_RATIO = 0.1
"""Minimum relative step of depth at an occlusion boundary: larger than the steps of a slanted surface."""

_MAX_GAP = 24
"""Maximum gap without depth between the two sides of a boundary, frame pixels of 640 columns: the shadow of a
projector. Wider gaps are masked objects."""

_BLUR = 2.0
"""Standard deviation of the blur of the colour image, frame pixels: the error of depth edges."""

_CONTRAST_WINDOW = 80
"""Side of the window in which gradients are divided by their mean, frame pixels; with the normalisation, a few strong
edges do not outweigh all others."""

_MIN_CONTRAST = 2.0
"""Mean gradient below which a window has no contrast, grey values per pixel: sensor noise."""

_MAX_GRADIENT = 4.0
"""Maximum normalised gradient: a strong edge counts as much as a few weak edges."""

_Image = NDArray[np.float32]


@dataclass(frozen=True)
class ViewEdges:
    """Occlusion boundaries of a depth image, and gradients of the colour image.

    Attributes:
        pixel: (column, row) of E boundaries, between a surface and one behind it, float64, shape :math:`(E, 2)`.
        depth: Depth of the surface in front, metres, float64, shape :math:`(E,)`.
        axis: Direction of the surface behind, 0 = left or right, 1 = above or below, int64, shape :math:`(E,)`.
        gradients: Normalised absolute gradients of the colour image along u and along v, minus their means, float32,
            shape :math:`(2, h, w)`.
    """

    pixel: Tensor
    depth: Tensor
    axis: Tensor
    gradients: Tensor


def view_pixels(length: int, columns: int, stride: int) -> int:
    """Return a length in pixels of a view, rounded down.

    Args:
        length: Length in frame pixels of 640 columns; frames with fewer columns have no shorter one.
        columns: Number of columns of the view.
        stride: Every n-th pixel of the frame's rows and columns is a pixel of the view.
    """
    return int(length * max(pixel_scale(columns * stride), 1.0)) // stride


def find_edges(colour: Tensor, depth: Tensor, stride: int) -> ViewEdges:
    """Find the occlusion boundaries of a depth image and the gradients of a colour image.

    Args:
        colour: RGB image, uint8, shape :math:`(3, h, w)`.
        depth: Depth, metres, float32, shape :math:`(h, w)`; 0 = no measurement or not static.
        stride: Every n-th pixel of the frame's rows and columns is a pixel of the images.
    """
    z, gap = depth.numpy(), max(view_pixels(_MAX_GAP, depth.shape[1], stride), 1)
    pixels, depths, axes = [], [], []
    for axis, image in enumerate((z, z.T)):
        for side, facing in ((-1, image), (1, image[:, ::-1])):
            row, column = np.nonzero(_is_in_front(facing, gap))
            depths.append(facing[row, column])
            position = (column if side < 0 else image.shape[1] - 1 - column) + side / 2
            pixels.append(np.stack([position, row] if axis == 0 else [row, position], axis=1))
            axes.append(np.full(len(row), axis))
    grey = cv2.cvtColor(np.ascontiguousarray(colour.permute(1, 2, 0).numpy()), cv2.COLOR_RGB2GRAY)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _BLUR / stride)
    gradients = [np.abs(cv2.Scharr(smooth, cv2.CV_32F, u, v)) / 32 for u, v in ((1, 0), (0, 1))]
    contrast = cv2.blur(gradients[0] + gradients[1], (max(_CONTRAST_WINDOW // stride, 1),) * 2) + _MIN_CONTRAST
    normalised = [np.minimum(gradient / contrast, _MAX_GRADIENT) for gradient in gradients]
    centred = [gradient - gradient.mean() for gradient in normalised]
    return ViewEdges(
        pixel=torch.from_numpy(np.concatenate(pixels).astype(np.float64)),
        depth=torch.from_numpy(np.concatenate(depths).astype(np.float64)),
        axis=torch.from_numpy(np.concatenate(axes)),
        gradients=torch.from_numpy(np.stack(centred)),
    )


def _is_in_front(depth: _Image, max_gap: int) -> NDArray[np.bool_]:
    """Mask of the pixels from which the next measurement to the left is much farther, (h, w)."""
    column = np.arange(depth.shape[1])
    last = np.maximum.accumulate(np.where(depth > 0, column, -max_gap - 1), axis=1)[:, :-1]  # last measured column
    before = np.take_along_axis(depth, np.maximum(last, 0), axis=1)
    in_front = np.zeros(depth.shape, np.bool_)
    in_front[:, 1:] = (column[1:] - last <= max_gap) & (depth[:, 1:] > 0) & (before > depth[:, 1:] * (1 + _EDGE_RATIO))
    return in_front
