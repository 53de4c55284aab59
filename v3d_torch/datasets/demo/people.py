"""People in the demo: three figures from two photographs, and their motions."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo.pictures import load_photograph
from v3d_torch.datasets.demo.scene import Figure, FigurePose, Vector

WALK_SPEED = 1.0
"""Speed of the walking person, m/s: a slow walk."""
WALK_START = 0.60
"""Time at which the centre of the walking person is at the left end of its path, seconds."""


def walk(t: float) -> FigurePose:
    """Return the pose of the walking person: constant velocity along x, and a small rise with each of two steps/s."""
    return FigurePose(shift=(WALK_SPEED * (t - WALK_START), 0.0, 0.015 * abs(math.sin(2 * math.pi * t))))


def sway(t: float) -> FigurePose:
    """Return the pose of the swaying person: lean and twist about the middle change the shape, not the centroid."""
    return FigurePose(
        lean=0.26 * math.sin(2 * math.pi * 1.0 * t),
        twist=0.40 * math.sin(2 * math.pi * 0.9 * t + 0.8),
    )


def recolour(rgba: NDArray[np.float32], hue_shift: float, hair: float) -> NDArray[np.float32]:
    """Change the colours of suit and hair in the photograph of the astronaut, to get another person.

    Args:
        rgba: Cut-out of the astronaut, in [0, 1], float32, shape :math:`(H, W, 4)`.
        hue_shift: Change of the hue of the suit (its strongly saturated texels), degrees.
        hair: Factor on the brightness of the hair.

    Returns:
        Recoloured cut-out, same shape.
    """
    hsv = cv2.cvtColor(np.ascontiguousarray(rgba[..., :3]), cv2.COLOR_RGB2HSV)
    rows = np.linspace(0, 1, rgba.shape[0], dtype=np.float32)[:, None]
    suit = _feather((rows > 0.33) & (hsv[..., 1] > 0.45) & (hsv[..., 0] < 40))
    shifted = cv2.cvtColor(
        np.dstack([(hsv[..., 0] + hue_shift) % 360, hsv[..., 1] * 0.75, hsv[..., 2] * 0.85]), cv2.COLOR_HSV2RGB
    )
    rgb = suit * shifted + (1 - suit) * rgba[..., :3]
    brown = _feather((rows < 0.24) & (hsv[..., 1] > 0.34) & (hsv[..., 0] > 22) & (hsv[..., 0] < 60))
    rgb = rgb * (1 - brown * (1 - hair))
    return np.dstack([rgb, rgba[..., 3]]).astype(np.float32)


def _feather(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Blur a mask to soft edges, shape :math:`(H, W, 1)`."""
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.2)[..., None])


def build_people(walker: Vector, stander: Vector, swayer: Vector) -> list[Figure]:
    """Build the three people.

    Args:
        walker: Left end of the path of the walking person, world frame, metres.
        stander: Position of the standing person.
        swayer: Position of the swaying person.

    Returns:
        The walking person (mask id 1), the standing person (0), and the swaying person (2).
    """
    astronaut, photographer = load_photograph("astronaut.png"), load_photograph("photographer.png")
    second_astronaut = recolour(astronaut, 165.0, 0.5)
    return [
        Figure(astronaut[:, ::-1], walker, 1.06, 0.20, motion=walk, mask_id=1),
        Figure(photographer, stander, 0.93, 0.18),
        Figure(second_astronaut, swayer, 1.00, 0.20, yaw=-0.15, motion=sway, mask_id=2, pivot=(0.40, 0.57)),
    ]
