"""Light baked into the textures: two ceiling panels with soft shadows, and ambient occlusion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo.geometry import Box, Rectangle, Vector

Points = NDArray[np.float64]

LIGHTMAP_DENSITY = 16.0
"""Texels of light per metre: soft shadows need no more."""
PANELS = ((-1.1, 1.6), (1.1, 2.6))
"""Centres (x, y) of the square ceiling panels, metres."""


def bake(rectangles: list[Rectangle], occluders: list[Box], low: Vector, high: Vector, seed: int) -> list[Rectangle]:
    """Multiply the light that falls on every rectangle into its texture.

    Args:
        rectangles: what is lit.
        occluders: boxes that cast shadows.
        low: the room's corner with the least coordinates.
        high: its opposite corner.
        seed: of the points on the lights and of the directions of the ambient occlusion.

    Returns:
        The same rectangles with darker and brighter textures.
    """
    rng = np.random.default_rng(seed)
    panels = np.concatenate(
        [np.column_stack([rng.uniform(-0.5, 0.5, (10, 2)) + centre, np.full(10, high[2] - 0.05)]) for centre in PANELS]
    )
    sphere = rng.normal(size=(40, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    boxes = np.asarray([(b.low, b.high) for b in occluders])
    return [replace(r, texture=_lit(r, panels, sphere, boxes, np.asarray((low, high)))) for r in rectangles]


def _lit(rectangle: Rectangle, panels: Points, sphere: Points, boxes: Points, room: Points) -> NDArray[np.float32]:
    across, down = np.asarray(rectangle.across), np.asarray(rectangle.down)
    columns, rows = (int(np.clip(np.linalg.norm(e) * LIGHTMAP_DENSITY, 4, 80)) for e in (across, down))
    s, t = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    points = rectangle.corner + s[..., None] * across + t[..., None] * down + 0.01 * rectangle.normal
    points = points.reshape(-1, 1, 3)

    to_light = panels - points  # (N, L, 3)
    distance = np.linalg.norm(to_light, axis=-1)
    facing = np.clip(to_light @ rectangle.normal / distance, 0.0, None)
    below = np.clip(to_light[..., 2] / distance, 0.0, None)
    direct = (facing * below / distance**2 * _clear(points, to_light, boxes)).mean(axis=1)

    hemisphere = np.where(sphere @ rectangle.normal[:, None] < 0, -sphere, sphere) * 0.7
    end = points + hemisphere
    inside = ((end >= room[0]) & (end <= room[1])).all(axis=-1)
    weight = hemisphere @ rectangle.normal
    ambient = (weight * (inside & _clear(points, np.broadcast_to(hemisphere, end.shape), boxes))).sum(1) / weight.sum()

    light = (0.34 + 0.42 * ambient + 1.25 * direct).reshape(rows, columns).astype(np.float32)
    height, width = rectangle.texture.shape[:2]
    light = cv2.resize(cv2.GaussianBlur(light, (0, 0), 0.8), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.clip(rectangle.texture * light[..., None], 0.0, 1.0), np.float32)


def _clear(start: Points, step: Points, boxes: Points) -> NDArray[np.bool_]:
    """Whether the segments ``start`` .. ``start + step`` miss every box (slab test, Kay and Kajiya, 1986)."""
    start, step = (np.ascontiguousarray(np.moveaxis(a, -1, 0)) for a in (start, step))  # (3, N, L)
    clear = np.ones(step.shape[1:], bool)
    inverse = 1.0 / np.where(np.abs(step) < 1e-9, 1e-9, step)
    for low, high in boxes.reshape(-1, 2, 3, 1, 1):
        first, second = (low - start) * inverse, (high - start) * inverse
        enter = np.minimum(first, second).max(axis=0)
        leave = np.maximum(first, second).min(axis=0)
        clear &= (enter > leave) | (leave < 0.0) | (enter > 1.0)
    return clear
