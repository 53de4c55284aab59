"""What the room is made of: textured rectangles, boxes of them, and cut-out figures with relief.

World frame: x right, y forward, z up, metres, origin on the floor below the camera's resting place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Rectangle:
    """A textured rectangle, seen from the side to which ``normal`` points.

    Attributes:
        corner: world position of the texture's top left corner.
        across: vector along the texture's top edge, its length the width.
        down: vector along the texture's left edge, its length the height.
        texture: RGB in [0, 1], float32, shape :math:`(H, W, 3)`.
    """

    corner: Vector
    across: Vector
    down: Vector
    texture: NDArray[np.float32]

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vector towards the viewer."""
        n = np.cross(self.down, self.across)
        return np.asarray(n / np.linalg.norm(n))


@dataclass(frozen=True)
class Box:
    """An axis-parallel box that casts shadows."""

    low: Vector
    high: Vector

    def faces(self, front: NDArray[np.float32], top: NDArray[np.float32], side: NDArray[np.float32]) -> list[Rectangle]:
        """The four faces that a camera in front of it and above may see."""
        (x0, y0, z0), (x1, y1, z1) = self.low, self.high
        return [
            Rectangle((x0, y0, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1), front),
            Rectangle((x0, y1, z1), (x1 - x0, 0, 0), (0, y0 - y1, 0), top),
            Rectangle((x0, y1, z1), (0, y0 - y1, 0), (0, 0, z0 - z1), side),
            Rectangle((x1, y0, z1), (0, y1 - y0, 0), (0, 0, z0 - z1), side),
        ]


@dataclass(frozen=True)
class Pose:
    """How a figure stands at one moment.

    Attributes:
        shift: displacement from where it was placed, metres.
        lean: sideways displacement per metre of height above the figure's pivot.
        twist: displacement towards the viewer per metre to the right of the figure's pivot.
    """

    shift: Vector = (0.0, 0.0, 0.0)
    lean: float = 0.0
    twist: float = 0.0


def stand(t: float) -> Pose:
    """The motion of what does not move."""
    return Pose()


@dataclass(frozen=True)
class Figure:
    """An upright cut-out with the relief of a body.

    Attributes:
        rgba: picture with its silhouette, in [0, 1], shape :math:`(H, W, 4)`.
        foot: world position of the middle of the picture's lower edge.
        height: metres.
        thickness: of the relief at its thickest, towards the viewer, metres.
        yaw: the figure turns about the vertical by this angle, radians; 0 looks towards -y.
        motion: pose over time, seconds.
        mover: 0 for a figure that stands still, else its id in the masks of moving pixels.
        pivot: what stays in place when the figure leans and twists: fraction of the width from the left, of the height
            from the top.
    """

    rgba: NDArray[np.float32]
    foot: Vector
    height: float
    thickness: float
    yaw: float = 0.0
    motion: Callable[[float], Pose] = stand
    mover: int = 0
    pivot: tuple[float, float] = (0.5, 0.5)

    @property
    def width(self) -> float:
        """Metres."""
        rows, columns = self.rgba.shape[:2]
        return self.height * float(columns) / float(rows)

    def rectangle(self, t: float) -> tuple[Rectangle, Pose]:
        """The plane on which the relief stands, and the pose, at time ``t``."""
        pose = self.motion(t)
        x, y, z = np.add(self.foot, pose.shift)
        dx, dy = self.width * np.cos(self.yaw), self.width * np.sin(self.yaw)
        corner = (x - dx / 2, y - dy / 2, z + self.height)
        return Rectangle(corner, (dx, dy, 0.0), (0.0, 0.0, -self.height), self.rgba[..., :3]), pose

    def shadow(self) -> Box:
        """A box about the figure's body, where it was placed."""
        x, y, z = self.foot
        half = 0.35 * self.width
        return Box((x - half, y - self.thickness, z + 0.02), (x + half, y, z + 0.9 * self.height))


@dataclass(frozen=True)
class Scene:
    """A room: what stays, and who is in it."""

    rectangles: list[Rectangle]
    figures: list[Figure]
