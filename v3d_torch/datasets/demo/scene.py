"""Scene description of the renderer: rigid bodies of textured rectangles and of figures with displacement mapping.

World frame: x right, y forward, z up, metres; its origin is on the floor below the rest position of the camera. Each
body has a frame of its own. The frame of a body at rest is the world frame, unless its motion says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo.camera_trajectory import CameraTrajectory
from v3d_torch.datasets.demo.motions import Motion, at_rest

Vector = tuple[float, float, float]

_MOTION_INTERVAL = 0.1
"""Time before and after a frame in which a body is checked for motion, seconds: longer than the turning points of a
gesture."""
_MOTION_DISTANCE = 0.002
"""Displacement in this time from which a body is moving, metres."""


@dataclass(frozen=True)
class Rectangle:
    """One-sided textured rectangle, visible from the side to which ``normal`` points.

    Attributes:
        corner: Position of the top left corner of the texture, body frame, metres.
        across: Vector along the top edge of the texture, as long as the rectangle is wide, body frame, metres.
        down: Vector along the left edge of the texture, as long as the rectangle is high, body frame, metres.
        texture: RGB in [0, 1], float32, shape :math:`(H, W, 3)`.
    """

    corner: Vector
    across: Vector
    down: Vector
    texture: NDArray[np.float32]

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal towards the visible side, body frame, shape :math:`(3,)`."""
        n = np.cross(self.down, self.across)
        return np.asarray(n / np.linalg.norm(n))

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners, body frame, metres, shape :math:`(4, 3)`."""
        corner, across, down = (np.asarray(v, float) for v in (self.corner, self.across, self.down))
        return np.stack([corner, corner + across, corner + down, corner + across + down])

    def transform(self, T_wb: NDArray[np.float64]) -> Rectangle:
        """Return the rectangle in the world frame.

        Args:
            T_wb: Body-to-world pose, float64, shape :math:`(4, 4)`.
        """
        R = T_wb[:3, :3]
        x, y, z = R @ self.corner + T_wb[:3, 3]
        (ax, ay, az), (dx, dy, dz) = R @ self.across, R @ self.down
        return Rectangle((x, y, z), (ax, ay, az), (dx, dy, dz), self.texture)


@dataclass(frozen=True)
class Box:
    """Axis-aligned box: a shape for furniture, and an occluder that casts shadows.

    Attributes:
        low: Position of the corner with the smallest coordinates, body frame, metres.
        high: Position of the opposite corner, body frame, metres.
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

    def closed_faces(self, front: NDArray[np.float32], top: NDArray[np.float32]) -> list[Rectangle]:
        """Return all six faces, for a body that turns; faces that get less light are darker.

        Args:
            front: Texture of the four upright faces, RGB in [0, 1], shape :math:`(H, W, 3)`.
            top: Texture of the top face and of the bottom face.
        """
        (x0, y0, z0), (x1, y1, z1) = self.low, self.high
        side, dark = front * np.float32(0.75), top * np.float32(0.45)
        return [
            *self.faces(front, top, side),
            Rectangle((x1, y1, z1), (x0 - x1, 0, 0), (0, 0, z0 - z1), front * np.float32(0.6)),
            Rectangle((x0, y0, z0), (x1 - x0, 0, 0), (0, y1 - y0, 0), dark),
        ]


@dataclass(frozen=True)
class Deformation:
    """Deformation of a figure at one time.

    Attributes:
        lean: Sideways displacement per metre of height above the pivot of the figure.
        twist: Displacement towards the viewer per metre to the right of the pivot of the figure.
    """

    lean: float = 0.0
    twist: float = 0.0


def keep_shape(t: float) -> Deformation:
    """Return the deformation of a rigid figure."""
    return Deformation()


@dataclass(frozen=True)
class Figure:
    """Cut-out photograph with a displacement map that gives it the relief of a body; upright in its body frame.

    Attributes:
        rgba: Picture with its silhouette, in [0, 1], float32, shape :math:`(H, W, 4)`.
        foot: Position of the middle of the lower edge of the picture, body frame, metres.
        height: Height of the picture, metres.
        thickness: Largest displacement towards the viewer, metres.
        yaw: Rotation about the vertical, radians; at 0 the figure faces -y.
        deformation: Deformation of the figure as a function of time in seconds.
        pivot: Point that stays in place when the figure leans and twists: fractions of the width from the left and of
            the height from the top.
    """

    rgba: NDArray[np.float32]
    foot: Vector
    height: float
    thickness: float
    yaw: float = 0.0
    deformation: Callable[[float], Deformation] = keep_shape
    pivot: tuple[float, float] = (0.5, 0.5)

    @property
    def width(self) -> float:
        """Width of the picture, metres."""
        rows, columns = self.rgba.shape[:2]
        return self.height * float(columns) / float(rows)

    def plane_at(self, T_wb: NDArray[np.float64]) -> Rectangle:
        """Return the base plane of the displacement map in the world frame.

        Args:
            T_wb: Body-to-world pose, float64, shape :math:`(4, 4)`.
        """
        R = T_wb[:3, :3]
        across = R @ (self.width * np.cos(self.yaw), self.width * np.sin(self.yaw), 0.0)
        up = R @ (0.0, 0.0, self.height)
        foot = R @ self.foot + T_wb[:3, 3]
        (x, y, z), (ax, ay, az), (dx, dy, dz) = foot - across / 2 + up, across, -up
        return Rectangle((x, y, z), (ax, ay, az), (dx, dy, dz), self.rgba[..., :3])

    def points_on(
        self, plane: Rectangle, s: NDArray[np.float64], t: NDArray[np.float64], time: float
    ) -> NDArray[np.float64]:
        """Return points on the deformed base plane.

        Args:
            plane: Result of `plane_at`.
            s: Horizontal texture coordinates, fractions of the width, shape :math:`(*)`.
            t: Vertical texture coordinates, fractions of the height, shape :math:`(*)`.
            time: Time, seconds.

        Returns:
            World points, metres, shape :math:`(*, 3)`.
        """
        deformation = self.deformation(time)
        across = s + deformation.lean * self.height / self.width * (self.pivot[1] - t)
        forward = deformation.twist * self.width * (s - self.pivot[0])
        return np.asarray(
            np.asarray(plane.corner)
            + across[..., None] * np.asarray(plane.across)
            + t[..., None] * np.asarray(plane.down)
            + forward[..., None] * plane.normal
        )

    def shadow_box(self) -> Box:
        """Return a box about the body at ``foot``, as an occluder for the lighting."""
        x, y, z = self.foot
        half = 0.35 * self.width
        return Box((x - half, y - self.thickness, z + 0.02), (x + half, y, z + 0.9 * self.height))


@dataclass(frozen=True)
class Body:
    """Rigid body: surfaces that move together, such as the room, a chair or the head of a person.

    Attributes:
        rectangles: Rectangles of the body.
        figures: Figures of the body; they can deform.
        motion: Body-to-world pose ``T_wb`` as a function of time in seconds.
        instance: Id of the person or thing in the masks, which several bodies can share; 0 for the room.
    """

    rectangles: list[Rectangle] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    motion: Motion = at_rest
    instance: int = 0

    def is_moving(self, time: float) -> bool:
        """Check whether a part of the body is displaced within 0.1 s before or after a time.

        Args:
            time: Time, seconds.
        """
        here = self._corners(time)
        others = [self._corners(time - _MOTION_INTERVAL), self._corners(time + _MOTION_INTERVAL)]
        return any(bool(np.linalg.norm(other - here, axis=1).max() > _MOTION_DISTANCE) for other in others)

    def _corners(self, time: float) -> NDArray[np.float64]:
        """Corners of all surfaces, world frame, metres, shape (N, 3)."""
        T_wb = self.motion(time)
        s, t = np.array([0.0, 1.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0, 1.0])
        corners = [rectangle.transform(T_wb).corners for rectangle in self.rectangles]
        corners += [figure.points_on(figure.plane_at(T_wb), s, t, time) for figure in self.figures]
        return np.concatenate(corners)


@dataclass(frozen=True)
class Scene:
    """Scene to render.

    Attributes:
        bodies: Bodies, static and moving; the walls of the room must fill every view.
        trajectory: Trajectory of the camera.
        labels: Class of each instance that a network trained on COCO can name, by instance id.
    """

    bodies: list[Body]
    trajectory: CameraTrajectory
    labels: dict[int, str] = field(default_factory=dict)
