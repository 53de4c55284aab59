"""Oriented BRIEF descriptors (Rublee et al., ICCV 2011; Calonder et al., ECCV 2010)."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from v3d_torch.kernels import brief as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

MARGIN = 21
"""Minimum distance of a corner from the image border, pixels: the radius of the patch that a descriptor depends on."""

_HALF_WIDTHS = (15, 15, 15, 15, 14, 14, 14, 13, 13, 12, 11, 10, 9, 8, 6, 3)
"""Half width of the disk of the intensity centroid in each row from its centre, pixels: a disk of radius 15 that is
symmetric about its diagonals (OpenCV)."""


_ROUNDING = float(kernels.ROUNDING)


def _describe_compiled(image: Tensor, smoothed: Tensor, corners: Tensor) -> Tensor:
    if len(corners) == 0:
        return NotImplemented
    points, half_widths = _test_points().numpy(), np.array(_HALF_WIDTHS)
    pixels, compared, centres = map(to_array, (image, smoothed, corners))
    return torch.from_numpy(kernels.describe(pixels, compared, centres, points, half_widths))


@compiled_by(_describe_compiled)
def describe(image: Tensor, smoothed: Tensor, corners: Tensor) -> Tensor:
    """Compute rotation-invariant descriptors: each bit compares two pixels of a pattern rotated with the corner.

    Args:
        image: Grey image, uint8, shape :math:`(H, W)`; the intensity centroid around a corner gives its direction.
        smoothed: Smoothed image, whose pixels are compared, uint8, shape :math:`(H, W)`.
        corners: Corners (column, row) at least `MARGIN` from the border, int64, shape :math:`(N, 2)`.

    Returns:
        Descriptors, uint8, shape :math:`(N, 32)`; the first comparison is the lowest bit of the first byte.
    """
    cosine, sine = _directions(image, corners).to(torch.float32)[..., None].unbind(dim=1)
    x, y = _test_points()
    rotated = torch.stack([cosine * x - sine * y, sine * x + cosine * y])
    columns, rows = corners.T[..., None] + (rotated + _ROUNDING).to(torch.int64) - int(_ROUNDING)
    first, second = smoothed[rows, columns].chunk(2, dim=1)
    bits = (first < second).reshape(-1, 32, 8)
    return (bits * 2 ** torch.arange(8)).sum(dim=2).to(torch.uint8)


def _directions(image: Tensor, corners: Tensor) -> Tensor:
    """Cosine and sine of the direction from each corner to its intensity centroid, float64, shape (N, 2)."""
    radius = len(_HALF_WIDTHS) - 1
    column = torch.arange(-radius, radius + 1)
    half_widths = torch.tensor(_HALF_WIDTHS)[column.abs()]
    offsets = torch.nonzero(column.abs() <= half_widths[:, None]).flip(1) - radius  # (x, y)
    columns, rows = (corners[:, None] + offsets).unbind(dim=2)
    moments = image[rows, columns].to(torch.float64) @ offsets.to(torch.float64)
    norm = (moments**2).sum(dim=1, keepdim=True).sqrt()
    return torch.where(norm > 0, moments / norm, torch.tensor([1.0, 0.0], dtype=torch.float64))


@cache
def _test_points() -> Tensor:
    """Test points (x, y), pixels: the first point of each of the 256 pairs, then the second; float32, shape (2, 512).

    The pattern is that of OpenCV, learned so that the bits are nearly uncorrelated.
    """
    pairs = np.loadtxt(Path(__file__).with_name("brief_pattern.csv"), delimiter=",", dtype=np.float32)
    return torch.from_numpy(np.ascontiguousarray(np.concatenate([pairs[:, :2], pairs[:, 2:]]).T))
