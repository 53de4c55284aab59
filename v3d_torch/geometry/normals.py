"""Normals of the surfaces that depth images show."""

from __future__ import annotations

from itertools import product

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor
from torch.nn.functional import pad


def surface_normals(points: Tensor, radius: int = 4, edge: float = 0.05) -> Tensor:
    """Cross products of the differences between a pixel's neighbours, averaged over a window.

    It is the cross products that are averaged: a window may be cut by an edge, and a plane still comes out as a plane,
    which an average of depth would bend there.

    Args:
        points: camera frame, metres, a point per pixel, z = 0 where there is none, shape :math:`(B, H, W, 3)`.
        radius: half the side of the window, of which every other row and column takes part, pixels.
        edge: a pixel whose depth differs by more than this share of another's lies on another surface.

    Returns:
        Unit vectors that point to the side of the camera, shape and dtype of ``points``; (0, 0, 0) where not all four
        neighbours are measured and on the pixel's surface.
    """
    KORNIA_CHECK_SHAPE(points, ["B", "H", "W", "3"])
    z = points[..., 2]
    right, left, below, above = (_shifted(points, *step) for step in ((0, 1), (0, -1), (1, 0), (-1, 0)))
    near = [(side[..., 2] > 0) & ((side[..., 2] - z).abs() <= edge * z) for side in (right, left, below, above)]
    known = torch.stack([z > 0, *near]).all(dim=0)[..., None]
    products = torch.where(known, torch.linalg.cross(below - above, right - left), 0.0)  # x right, y down: to -z
    steps = range(-radius, radius + 1, 2) if radius else (0,)
    total = torch.zeros_like(products)
    for step in product(steps, steps):
        same = (_shifted(z[..., None], *step) - z[..., None]).abs() <= edge * z[..., None]
        total += same * _shifted(products, *step)
    return torch.where(known, total / total.norm(dim=-1, keepdim=True).clamp(min=1e-30), 0.0)


def _shifted(images: Tensor, rows: int, columns: int) -> Tensor:
    """Images whose pixel (v, u) is what was (v + rows, u + columns), 0 beyond the border, (B, H, W, C)."""
    height, width = images.shape[1:3]
    reach = max(abs(rows), abs(columns))
    padded = pad(images, (0, 0, reach, reach, reach, reach))
    return padded[:, reach + rows : reach + rows + height, reach + columns : reach + columns + width]
