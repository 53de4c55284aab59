"""Scene description of the renderer: textured rectangles, boxes, and figures with displacement mapping.

World frame: x right, y forward, z up, metres; its origin is on the floor below the rest position of the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Rectangle:
    """One-sided textured rectangle, visible from the side to which ``normal`` points.

    Attributes:
        corner: World position of the top left corner of the texture, metres.
        across: World vector along the top edge of the texture, as long as the rectangle is wide, metres.
        down: World vector along the left edge of the texture, as long as the rectangle is high, metres.
        texture: RGB in [0, 1], float32, shape :math:`(H, W, 3)`.
    """

    corner: Vector
    across: Vector
    down: Vector
    texture: NDArray[np.float32]

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal towards the visible side, world frame, shape :math:`(3,)`."""
        n = np.cross(self.down, self.across)
        return np.asarray(n / np.linalg.norm(n))


@dataclass(frozen=True)
class Box:
    """Axis-aligned box: a shape for furniture, and an occluder that casts shadows.

    Attributes:
        low: World position of the corner with the smallest coordinates, metres.
        high: World position of the opposite corner, metres.
    """

    low: Vector
    high: Vector

    def faces(self, front: NDArray[np.float32], top: NDArray[np.float32], side: NDArray[np.float32]) -> list[Rectangle]:
        """Return the four faces that are visible from the front and from above.

        Args:
            front: Texture of the face towards -y, RGB in [0, 1], shape :math:`(H, W, 3)`.
            top: Texture of the top face.
            side: Texture of the left face and of the right face.
        """
        (x0, y0, z0), (x1, y1, z1) = self.low, self.high
        return [
            Rectangle((x0, y0, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1), front),
            Rectangle((x0, y1, z1), (x1 - x0, 0, 0), (0, y0 - y1, 0), top),
            Rectangle((x0, y1, z1), (0, y0 - y1, 0), (0, 0, z0 - z1), side),
            Rectangle((x1, y0, z1), (0, y1 - y0, 0), (0, 0, z0 - z1), side),
        ]


@dataclass(frozen=True)
class FigurePose:
    """Pose and deformation of a figure at one time.

    Attributes:
        shift: Displacement from `Figure.foot`, world frame, metres.
        lean: Sideways displacement per metre of height above the pivot of the figure.
        twist: Displacement towards the viewer per metre to the right of the pivot of the figure.
    """

    shift: Vector = (0.0, 0.0, 0.0)
    lean: float = 0.0
    twist: float = 0.0


def stand_still(t: float) -> FigurePose:
    """Return the pose of a static figure."""
    return FigurePose()


@dataclass(frozen=True)
class Figure:
    """Upright cut-out photograph with a displacement map that gives it the relief of a body.

    Attributes:
        rgba: Picture with its silhouette, in [0, 1], float32, shape :math:`(H, W, 4)`.
        foot: World position of the middle of the lower edge of the picture if the shift of the pose is zero, metres.
        height: Height of the picture, metres.
        thickness: Largest displacement towards the viewer, metres.
        yaw: Rotation about the vertical, radians; at 0 the figure faces -y.
        motion: Pose of the figure as a function of time in seconds.
        mask_id: Id of the figure in the motion masks; 0 for a static figure.
        pivot: Point that stays in place when the figure leans and twists: fractions of the width from the left and of
            the height from the top.
    """

    rgba: NDArray[np.float32]
    foot: Vector
    height: float
    thickness: float
    yaw: float = 0.0
    motion: Callable[[float], FigurePose] = stand_still
    mask_id: int = 0
    pivot: tuple[float, float] = (0.5, 0.5)

    @property
    def width(self) -> float:
        """Width of the picture, metres."""
        rows, columns = self.rgba.shape[:2]
        return self.height * float(columns) / float(rows)

    def plane_at(self, t: float) -> tuple[Rectangle, FigurePose]:
        """Return the base plane of the displacement map, and the pose of the figure.

        Args:
            t: Time, seconds.
        """
        pose = self.motion(t)
        x, y, z = np.add(self.foot, pose.shift)
        dx, dy = self.width * np.cos(self.yaw), self.width * np.sin(self.yaw)
        corner = (x - dx / 2, y - dy / 2, z + self.height)
        return Rectangle(corner, (dx, dy, 0.0), (0.0, 0.0, -self.height), self.rgba[..., :3]), pose

    def shadow_box(self) -> Box:
        """Return a box about the body at ``foot``, as an occluder for the lighting."""
        x, y, z = self.foot
        half = 0.35 * self.width
        return Box((x - half, y - self.thickness, z + 0.02), (x + half, y, z + 0.9 * self.height))


@dataclass(frozen=True)
class Scene:
    """Scene to render.

    Attributes:
        rectangles: Static surfaces.
        figures: Figures, static and moving.
    """

    rectangles: list[Rectangle]
    figures: list[Figure]
