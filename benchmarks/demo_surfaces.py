"""Exact surfaces of the demo's room and people, as dense points, for comparison with maps."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from v3d_torch.datasets.demo.displacement import displacement_map
from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.scene import Body, Figure, Rectangle, Scene
from v3d_torch.datasets.demo.sequence import CAMERA, FRAME_RATE
from v3d_torch.types import RGBDFrame

STEP = 0.005
"""Distance between points, metres: a tenth of a voxel."""


def static_surfaces(scene: Scene) -> Tensor:
    """Points on all static surfaces, frame of the demo, metres, float64, shape (N, 3)."""
    return torch.cat([body_points(body, 0.0) for body in scene.bodies if not body.is_moving(0.0)])


def body_points(body: Body, time: float) -> Tensor:
    """Points on a body at a time, metres, (N, 3)."""
    T_wb = body.motion(time)
    rectangles = [rectangle_points(rectangle.transform(T_wb)) for rectangle in body.rectangles]
    return torch.cat([*rectangles, *(figure_points(figure, T_wb, time) for figure in body.figures)])


def rectangle_points(rectangle: Rectangle) -> Tensor:
    """Points on a rectangle, metres, (N, 3)."""
    corner, across, down = (np.asarray(v, float) for v in (rectangle.corner, rectangle.across, rectangle.down))
    s, t = fractions(float(np.linalg.norm(across))), fractions(float(np.linalg.norm(down)))
    grid = np.stack(np.meshgrid(s, t), axis=-1).reshape(-1, 2)
    return torch.from_numpy(corner + grid @ np.stack([across, down]))


def figure_points(figure: Figure, T_wb: np.ndarray, time: float) -> Tensor:
    """Points on the relief of a figure at a time, metres, (N, 3); see `intersect_figure`."""
    plane = figure.plane_at(T_wb)
    relief, alpha = displacement_map(figure).numpy()
    s, t = np.meshgrid(fractions(figure.width), fractions(figure.height))
    texel = (t * relief.shape[0]).astype(int), (s * relief.shape[1]).astype(int)
    points = figure.points_on(plane, s, t, time) + relief[texel][..., None] * plane.normal
    return torch.from_numpy(points[alpha[texel] > 0.5])


def fractions(length: float) -> np.ndarray:
    """Middles of equal parts of a length, as fractions of it."""
    count = max(int(np.ceil(length / STEP)), 1)
    return (np.arange(count) + 0.5) / count


def seen_points(renderer: Renderer, frame: RGBDFrame, max_depth: float) -> Tensor:
    """Exact positions of the static pixels with a depth measurement, frame of the demo, metres, (N, 3).

    Args:
        renderer: Renderer of the demo.
        frame: Frame of the demo.
        max_depth: Maximum depth, metres.
    """
    time = frame.index / FRAME_RATE
    T_wc = torch.from_numpy(renderer.scene.trajectory.pose(time))
    exact = renderer(T_wc.numpy(), time)
    seen = (frame.depth[0] > 0) & (exact.motion_mask == 0) & (exact.depth <= max_depth)
    points = (CAMERA.rays * exact.depth[..., None])[seen].to(torch.float64)
    return points @ T_wc[:3, :3].T + T_wc[:3, 3]
