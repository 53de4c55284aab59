"""Figures with relief: a cut-out photograph gets the roundness of a body, and rays find it by fixed-point iteration."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from v3d_torch.datasets.demo.geometry import Figure
from v3d_torch.datasets.demo.view import View, Window

STEPS = 4
"""Fixed-point iterations (iterated parallax mapping): the slopes are gentle and the figures about face the camera."""


@dataclass(frozen=True)
class Hits:
    """Where the rays of a window meet a figure, each of shape :math:`(S, h, w)`.

    Attributes:
        window: of the image.
        inside: whether the ray meets the silhouette.
        depth: metres along z.
        s: fraction of the picture's width.
        t: fraction of the picture's height.
    """

    window: Window
    inside: Tensor
    depth: Tensor
    s: Tensor
    t: Tensor


def relief_map(figure: Figure) -> Tensor:
    """Thickness in metres, rounded towards the silhouette, and the silhouette, shape :math:`(2, H, W)`."""
    alpha = figure.rgba[..., 3]
    solid = cv2.copyMakeBorder((alpha > 0.5).astype(np.uint8), 1, 0, 1, 1, cv2.BORDER_CONSTANT, value=0)
    inward = cv2.distanceTransform(solid, cv2.DIST_L2, 5)[1:, 1:-1] * (figure.height / alpha.shape[0])
    relief = np.sin(np.clip(inward / (1.3 * figure.thickness), 0.0, 1.0) * np.pi / 2) * figure.thickness
    relief = cv2.GaussianBlur(relief, (0, 0), 0.012 * alpha.shape[0])
    return torch.from_numpy(np.stack([relief, alpha]).astype(np.float32))


def intersect(figure: Figure, relief: Tensor, view: View, time: float) -> Hits | None:
    """Meet the rays with a figure.

    The ray is met with the figure's plane, displaced by the relief found there, until both agree; the figure's lean and
    twist are undone on the way, so that its picture and relief are looked up at rest.

    Args:
        figure: what to meet.
        relief: its :func:`relief_map`.
        view: the rays.
        time: seconds.

    Returns:
        None when the figure is out of view.
    """
    rectangle, pose = figure.rectangle(time)
    corner, across, down = (np.asarray(v, float) for v in (rectangle.corner, rectangle.across, rectangle.down))
    normal = rectangle.normal
    lean = pose.lean * figure.height / figure.width  # widths per height
    front = normal * (figure.thickness + abs(pose.twist) * figure.width)
    sideways = across * (abs(lean) * max(figure.pivot[1], 1.0 - figure.pivot[1]))
    body = [corner + i * across + j * down for i in (0, 1) for j in (0, 1)]
    window = view.window(np.stack([p + f + e for p in body for f in (front, -front) for e in (sideways, -sideways)]))
    if window is None:
        return None
    origin = view.point(corner)
    across, down, normal = (view.direction(e) for e in (across / (across @ across), down / (down @ down), normal))
    on_normal, on_across, on_down = (view.along(e, window) for e in (normal, across, down))
    distance, left, top = (float(origin @ e) for e in (normal, across, down))
    thickness: Tensor | float = figure.thickness / 2
    for _ in range(STEPS):
        depth = (thickness + distance) / on_normal
        t = depth * on_down - top
        s = depth * on_across - (left + lean * figure.pivot[1]) + lean * t
        found, alpha = _look_up(relief, s, t)
        thickness = found + pose.twist * figure.width * (s - figure.pivot[0])
    return Hits(window, alpha > 0.5, depth, s, t)


def _look_up(maps: Tensor, s: Tensor, t: Tensor) -> Tensor:
    grid = torch.stack([2.0 * s - 1.0, 2.0 * t - 1.0], dim=-1).flatten(0, 1)
    found: Tensor = grid_sample(maps[None], grid[None], align_corners=False)
    return found.reshape(maps.shape[0], *s.shape)
