"""The hand-held camera's path: a sum of sines with exact poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

REST = (0.0, 0.0, 1.40)
"""Where the camera hovers, metres: eye height behind the counter."""
PITCH_DEGREES = -5.5
"""Looks down a little."""

# Amplitude, frequency (hertz), phase; metres for x, y, z, degrees for yaw, pitch, roll. The last of each is the tremor.
SWINGS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "x": ((0.17, 0.31, 0.3), (0.05, 0.83, 1.9), (0.0012, 7.3, 0.4)),
    "y": ((0.10, 0.27, 2.1), (0.03, 0.71, 0.2), (0.0010, 8.1, 1.1)),
    "z": ((0.045, 0.43, 1.2), (0.015, 1.10, 0.7), (0.0015, 6.7, 2.2)),
    "yaw": ((4.0, 0.33, 1.0), (1.2, 0.97, 2.5), (0.07, 7.9, 0.1)),
    "pitch": ((1.8, 0.39, 0.5), (0.7, 1.21, 1.3), (0.08, 8.9, 0.9)),
    "roll": ((2.6, 0.29, 2.8), (0.8, 0.89, 0.6), (0.06, 6.1, 1.7)),
}

# Camera axes (x right, y down, z forward) of a level camera in the world (x right, y forward, z up).
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def camera_pose(t: float) -> NDArray[np.float64]:
    """Pose at a time.

    Args:
        t: seconds from the sequence's start.

    Returns:
        ``T_wc``, camera-to-world, shape :math:`(4, 4)`.
    """
    value = {
        name: sum(a * np.sin(2 * np.pi * f * t + phase) for a, f, phase in waves) for name, waves in SWINGS.items()
    }
    angles = (value["yaw"], value["pitch"] + PITCH_DEGREES, value["roll"])
    # About the camera's own axes: yaw left about the world's up, then pitch up, then roll about the line of sight.
    turn = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    T_wc = np.eye(4)
    T_wc[:3, :3] = turn @ LEVEL
    T_wc[:3, 3] = np.add(REST, (value["x"], value["y"], value["z"]))
    return T_wc
