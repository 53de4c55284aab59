"""Motions of rigid bodies: poses as functions of time, from key poses, oscillations, joints and limbs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Motion = Callable[[float], NDArray[np.float64]]
"""Body-to-world pose ``T_wb``, float64, shape (4, 4), as a function of time in seconds."""

Path = Callable[[float], NDArray[np.float64]]
"""Position, world frame, metres, shape (3,), as a function of time in seconds."""


def at_rest(t: float) -> NDArray[np.float64]:
    """Return the pose of a body whose frame is the world frame."""
    return np.eye(4)


def interpolate(keys: Sequence[tuple[float, ArrayLike]]) -> Path:
    """Interpolate values at given times as a hand moves: with minimum jerk (Flash and Hogan, 1985), at rest at each.

    Args:
        keys: Times in seconds, increasing, and their values; before the first and after the last time the value stays.

    Returns:
        Value as a function of time, float64.
    """
    times = np.array([time for time, _ in keys])
    values = np.array([value for _, value in keys], np.float64)

    def value_at(t: float) -> NDArray[np.float64]:
        if t <= times[0]:
            return np.asarray(values[0])
        if t >= times[-1]:
            return np.asarray(values[-1])
        i = int(np.searchsorted(times, t, side="right")) - 1
        u = (t - times[i]) / (times[i + 1] - times[i])
        return np.asarray(values[i] + u**3 * (10.0 - 15.0 * u + 6.0 * u**2) * (values[i + 1] - values[i]))

    return value_at


def make_pose(position: ArrayLike, angles: ArrayLike = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Return a pose.

    Args:
        position: Origin of the body, metres.
        angles: Intrinsic rotations about z (to the left), x (up) and y (clockwise for the viewer), degrees.

    Returns:
        Pose, float64, shape :math:`(4, 4)`.
    """
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    T[:3, 3] = position
    return T


def move(keys: Sequence[tuple[float, ArrayLike]]) -> Motion:
    """Return a motion through key poses.

    Args:
        keys: Times, and x, y, z (metres) followed by the three angles of `make_pose` (degrees), see `interpolate`.
    """
    value_at = interpolate(keys)
    return lambda t: make_pose(value_at(t)[:3], value_at(t)[3:])


def attach(parent: Motion, joint: ArrayLike, angles: Path) -> Motion:
    """Return the motion of a part that turns about a joint of its parent.

    Args:
        parent: Motion of the parent.
        joint: Position of the joint in the frame of the parent, metres; the origin of the part.
        angles: The three angles of `make_pose` as a function of time, degrees.
    """
    return lambda t: np.asarray(parent(t) @ make_pose(joint, angles(t)))


def point_on(parent: Motion, point: ArrayLike) -> Path:
    """Return the path of a point of a body, given in the body frame, metres."""
    return lambda t: np.asarray(parent(t)[:3, :3] @ np.asarray(point) + parent(t)[:3, 3])


def bend(shoulder: Path, hand: Path, lengths: tuple[float, float], pole: ArrayLike) -> Path:
    """Return the path of the elbow of a limb with two parts (two-bone inverse kinematics).

    Args:
        shoulder: Path of the upper end.
        hand: Path of the lower end; where it is out of reach, the limb points to it.
        lengths: Lengths of the upper and of the lower part, metres.
        pole: World vector towards which the elbow points, not along the limb.
    """
    upper, lower = lengths

    def elbow(t: float) -> NDArray[np.float64]:
        start, end = shoulder(t), hand(t)
        direction = end - start
        distance = float(np.linalg.norm(direction))
        direction = direction / distance
        reach = min(distance, 0.999 * (upper + lower))
        along = min(max((upper**2 - lower**2 + reach**2) / (2.0 * reach), -upper), upper)
        side = np.asarray(pole, np.float64) - (np.asarray(pole) @ direction) * direction
        height = np.sqrt(upper**2 - along**2)
        return np.asarray(start + along * direction + height * side / np.linalg.norm(side))

    return elbow


def span(start: Path, end: Path) -> Motion:
    """Return the motion of a limb from one point towards another one, which shows its broad side to the viewer.

    Args:
        start: Path of the origin of the body.
        end: Path of a point on its -z axis.
    """

    def pose(t: float) -> NDArray[np.float64]:
        origin = start(t)
        z = origin - end(t)
        z = z / np.linalg.norm(z)
        x = np.cross((0.0, 1.0, 0.0), z)
        x = x / np.linalg.norm(x)
        T_wb = np.eye(4)
        T_wb[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        T_wb[:3, 3] = origin
        return T_wb

    return pose
