"""Light baked into textures: two ceiling panels with soft shadows, and ambient occlusion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo.scene import Box, Rectangle, Vector

Points = NDArray[np.float64]

_LIGHTMAP_DENSITY = 16.0
"""Texels of the light map per metre: enough for soft shadows."""
_LIGHTMAP_SIZE = (4, 80)
"""Smallest and largest side of a light map, texels."""
_PANEL_CENTRES = ((-1.1, 1.6), (1.1, 2.6))
"""Centres (x, y) of the two ceiling panels, world frame, metres; a panel is 1 m x 1 m."""
_POINTS_PER_PANEL = 10
"""Random points on a panel that sample its light."""
_AMBIENT_DIRECTIONS = 40
"""Random directions that sample the ambient occlusion."""
_OCCLUSION_RADIUS = 0.7
"""Length of the rays for ambient occlusion, metres."""
_SURFACE_OFFSET = 0.01
"""Rays start this far in front of a surface, metres, so that they do not hit the surface itself."""
_BASE_LIGHT, _AMBIENT_LIGHT, _DIRECT_LIGHT = 0.34, 0.42, 1.25
"""Weights of constant, ambient and direct light."""


def bake_lighting(
    rectangles: list[Rectangle], occluders: list[Box], low: Vector, high: Vector, seed: int
) -> list[Rectangle]:
    """Multiply the incident light of all rectangles into their textures.

    Args:
        rectangles: Surfaces to light.
        occluders: Boxes that cast shadows.
        low: Corner of the room with the smallest coordinates, world frame, metres.
        high: Opposite corner of the room.
        seed: Seed of the sample points on the panels and of the directions of ambient occlusion.

    Returns:
        The rectangles with lit textures.
    """
    rng = np.random.default_rng(seed)
    panels = [
        np.column_stack(
            [rng.uniform(-0.5, 0.5, (_POINTS_PER_PANEL, 2)) + centre, np.full(_POINTS_PER_PANEL, high[2] - 0.05)]
        )
        for centre in _PANEL_CENTRES
    ]
    directions = rng.normal(size=(_AMBIENT_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    boxes = np.asarray([(b.low, b.high) for b in occluders])
    room = np.asarray((low, high))
    lights = np.concatenate(panels)
    return [replace(r, texture=_light_texture(r, lights, directions, boxes, room)) for r in rectangles]


def _light_texture(
    rectangle: Rectangle, lights: Points, directions: Points, boxes: Points, room: Points
) -> NDArray[np.float32]:
    """Return the texture of a rectangle times its light map."""
    across, down = np.asarray(rectangle.across), np.asarray(rectangle.down)
    columns, rows = (int(np.clip(np.linalg.norm(e) * _LIGHTMAP_DENSITY, *_LIGHTMAP_SIZE)) for e in (across, down))
    s, t = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    points = rectangle.corner + s[..., None] * across + t[..., None] * down + _SURFACE_OFFSET * rectangle.normal
    points = points.reshape(-1, 1, 3)

    to_light = lights - points  # (N, L, 3)
    distance = np.linalg.norm(to_light, axis=-1)
    surface_cosine = np.clip(to_light @ rectangle.normal / distance, 0.0, None)
    panel_cosine = np.clip(to_light[..., 2] / distance, 0.0, None)
    unoccluded = _is_unoccluded(points, to_light, boxes)
    direct = (surface_cosine * panel_cosine / distance**2 * unoccluded).mean(axis=1)

    # Mirror the directions into the hemisphere above the surface.
    hemisphere = np.where(directions @ rectangle.normal[:, None] < 0, -directions, directions) * _OCCLUSION_RADIUS
    end = points + hemisphere
    in_room = ((end >= room[0]) & (end <= room[1])).all(axis=-1)
    weight = hemisphere @ rectangle.normal
    unoccluded = _is_unoccluded(points, np.broadcast_to(hemisphere, end.shape), boxes)
    ambient = (weight * (in_room & unoccluded)).sum(1) / weight.sum()

    light = _BASE_LIGHT + _AMBIENT_LIGHT * ambient + _DIRECT_LIGHT * direct
    light = light.reshape(rows, columns).astype(np.float32)
    height, width = rectangle.texture.shape[:2]
    light = cv2.resize(cv2.GaussianBlur(light, (0, 0), 0.8), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.clip(rectangle.texture * light[..., None], 0.0, 1.0), np.float32)


def _is_unoccluded(start: Points, step: Points, boxes: Points) -> NDArray[np.bool_]:
    """Check whether the segments ``start`` .. ``start + step`` miss all boxes (slab test, Kay and Kajiya, 1986)."""
    start, step = (np.ascontiguousarray(np.moveaxis(a, -1, 0)) for a in (start, step))  # (3, N, L)
    unoccluded = np.ones(step.shape[1:], bool)
    inverse = 1.0 / np.where(np.abs(step) < 1e-9, 1e-9, step)
    for low, high in boxes.reshape(-1, 2, 3, 1, 1):
        first, second = (low - start) * inverse, (high - start) * inverse
        enter = np.minimum(first, second).max(axis=0)
        leave = np.maximum(first, second).min(axis=0)
        unoccluded &= (enter > leave) | (leave < 0.0) | (enter > 1.0)
    return unoccluded
