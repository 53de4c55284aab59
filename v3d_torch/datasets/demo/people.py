"""Who is in the room: cut-outs of two photographs, and how they move."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo.geometry import Figure, Pose, Vector
from v3d_torch.datasets.demo.pictures import photograph

WALK_SPEED = 1.0
"""Of the walker, m/s: 3.3 cm a frame."""
WALK_START = 0.60
"""Seconds until the walker's centre is at the left end of the way."""


def walk(t: float) -> Pose:
    """Glide to the right, the body rising 1.5 cm with each of two steps a second."""
    return Pose(shift=(WALK_SPEED * (t - WALK_START), 0.0, 0.015 * abs(math.sin(2 * math.pi * t))))


def sway(t: float) -> Pose:
    """Lean from side to side about the middle and turn the shoulders: the shape moves, the centroid stays."""
    return Pose(
        lean=0.26 * math.sin(2 * math.pi * 1.0 * t),
        twist=0.40 * math.sin(2 * math.pi * 0.9 * t + 0.8),
    )


def recolour(rgba: NDArray[np.float32], hue_shift: float, hair: float) -> NDArray[np.float32]:
    """Another suit and darker hair on the astronaut.

    Args:
        rgba: the cut-out.
        hue_shift: of strongly coloured texels (the suit), degrees.
        hair: factor on the brightness of the hair.

    Returns:
        The same shape.
    """
    hsv = cv2.cvtColor(np.ascontiguousarray(rgba[..., :3]), cv2.COLOR_RGB2HSV)
    rows = np.linspace(0, 1, rgba.shape[0], dtype=np.float32)[:, None]
    suit = _soft((rows > 0.33) & (hsv[..., 1] > 0.45) & (hsv[..., 0] < 40))
    other = cv2.cvtColor(
        np.dstack([(hsv[..., 0] + hue_shift) % 360, hsv[..., 1] * 0.75, hsv[..., 2] * 0.85]), cv2.COLOR_HSV2RGB
    )
    rgb = suit * other + (1 - suit) * rgba[..., :3]
    brown = _soft((rows < 0.24) & (hsv[..., 1] > 0.34) & (hsv[..., 0] > 22) & (hsv[..., 0] < 60))
    rgb = rgb * (1 - brown * (1 - hair))
    return np.dstack([rgb, rgba[..., 3]]).astype(np.float32)


def _soft(region: NDArray[np.bool_]) -> NDArray[np.float32]:
    """A region with soft edges, shape :math:`(H, W, 1)`."""
    return np.asarray(cv2.GaussianBlur(region.astype(np.float32), (0, 0), 1.2)[..., None])


def people(walker: Vector, stander: Vector, swayer: Vector) -> list[Figure]:
    """Three people at the given places (the walker's is where the way begins).

    Returns:
        The one who walks (mover 1), the one who stands still, the one who sways (mover 2).
    """
    astronaut, photographer = photograph("astronaut.png"), photograph("photographer.png")
    other = recolour(astronaut, 165.0, 0.5)
    return [
        Figure(astronaut[:, ::-1], walker, 1.06, 0.20, motion=walk, mover=1),
        Figure(photographer, stander, 0.93, 0.18),
        Figure(other, swayer, 1.00, 0.20, yaw=-0.15, motion=sway, mover=2, pivot=(0.40, 0.57)),
    ]
