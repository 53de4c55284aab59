"""Displacement mapping of figures: rays are intersected with a relief by fixed-point iteration."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from v3d_torch.datasets.demo.scene import Figure
from v3d_torch.datasets.demo.view import View, Window

_ITERATIONS = 4
"""Fixed-point iterations (iterative parallax mapping): enough for gentle slopes that face the camera."""


@dataclass(frozen=True)
class RayHits:
    """Intersections of the rays in a window with a figure.

    Attributes:
        window: Part of the image.
        inside: True if the ray hits the silhouette, bool, shape :math:`(S, h, w)`.
        depth: Depth along z, metres, shape :math:`(S, h, w)`.
        s: Horizontal texture coordinate, fraction of the width, shape :math:`(S, h, w)`.
        t: Vertical texture coordinate, fraction of the height, shape :math:`(S, h, w)`.
    """

    window: Window
    inside: Tensor
    depth: Tensor
    s: Tensor
    t: Tensor


def displacement_map(figure: Figure) -> Tensor:
    """Compute a displacement map that is rounded towards the silhouette.

    Returns:
        Displacement towards the viewer (metres) and silhouette in [0, 1], float32, shape :math:`(2, H, W)`.
    """
    alpha = figure.rgba[..., 3]
    # No border below: the lower edge of the picture cuts the body, which is not rounded there.
    solid = cv2.copyMakeBorder((alpha > 0.5).astype(np.uint8), 1, 0, 1, 1, cv2.BORDER_CONSTANT, value=0)
    to_silhouette = cv2.distanceTransform(solid, cv2.DIST_L2, 5)[1:, 1:-1] * (figure.height / alpha.shape[0])
    relief = np.sin(np.clip(to_silhouette / (1.3 * figure.thickness), 0.0, 1.0) * np.pi / 2) * figure.thickness
    relief = cv2.GaussianBlur(relief, (0, 0), 0.012 * alpha.shape[0])
    return torch.from_numpy(np.stack([relief, alpha]).astype(np.float32))


def intersect_figure(
    figure: Figure, displacement: Tensor, view: View, T_wb: NDArray[np.float64], time: float
) -> RayHits | None:
    """Intersect camera rays with a figure.

    Each iteration intersects the rays with the base plane shifted by the displacement that the last iteration found.
    Lean and twist are inverted in texture coordinates, so that picture and displacement are sampled undeformed.

    Args:
        figure: Figure to intersect.
        displacement: Result of `displacement_map` for the figure.
        view: Camera rays.
        T_wb: Body-to-world pose of the figure, float64, shape :math:`(4, 4)`.
        time: Time, seconds, for the deformation.

    Returns:
        Intersections; None if the figure is out of view.
    """
    plane, deformation = figure.plane_at(T_wb), figure.deformation(time)
    corner, across, down = (np.asarray(v, float) for v in (plane.corner, plane.across, plane.down))
    normal = plane.normal
    lean = deformation.lean * figure.height / figure.width  # as a shift in widths per height
    # Bounding volume: the rectangle, extended by the largest displacement, twist and lean.
    forward = normal * (figure.thickness + abs(deformation.twist) * figure.width)
    sideways = across * (abs(lean) * max(figure.pivot[1], 1.0 - figure.pivot[1]))
    corners = [corner + i * across + j * down for i in (0, 1) for j in (0, 1)]
    bounds = [p + f + e for p in corners for f in (forward, -forward) for e in (sideways, -sideways)]
    window = view.visible_window(np.stack(bounds))
    if window is None:
        return None
    origin = view.transform_to_camera(corner)
    across, down, normal = (
        view.rotate_to_camera(e) for e in (across / (across @ across), down / (down @ down), normal)
    )
    ray_normal, ray_across, ray_down = (view.dot_rays(e, window) for e in (normal, across, down))
    origin_normal, origin_across, origin_down = (float(origin @ e) for e in (normal, across, down))
    offset: Tensor | float = figure.thickness / 2
    for _ in range(_ITERATIONS):
        depth = (offset + origin_normal) / ray_normal
        t = depth * ray_down - origin_down
        s = depth * ray_across - (origin_across + lean * figure.pivot[1]) + lean * t
        relief, alpha = _sample(displacement, s, t)
        offset = relief + deformation.twist * figure.width * (s - figure.pivot[0])
    return RayHits(window, alpha > 0.5, depth, s, t)


def _sample(maps: Tensor, s: Tensor, t: Tensor) -> Tensor:
    """Sample maps (C, H, W) bilinearly at texture coordinates; 0 outside."""
    grid = torch.stack([2.0 * s - 1.0, 2.0 * t - 1.0], dim=-1).flatten(0, 1)
    sampled: Tensor = grid_sample(maps[None], grid[None], align_corners=False)
    return sampled.reshape(maps.shape[0], *s.shape)
