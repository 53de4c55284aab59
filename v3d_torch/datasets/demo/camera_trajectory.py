"""Trajectory of the hand-held camera: a sum of sines, so that poses are exact at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_OSCILLATIONS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "x": ((0.17, 0.31, 0.3), (0.05, 0.83, 1.9), (0.0012, 7.3, 0.4)),
    "y": ((0.10, 0.27, 2.1), (0.03, 0.71, 0.2), (0.0010, 8.1, 1.1)),
    "z": ((0.045, 0.43, 1.2), (0.015, 1.10, 0.7), (0.0015, 6.7, 2.2)),
    "yaw": ((4.0, 0.33, 1.0), (1.2, 0.97, 2.5), (0.07, 7.9, 0.1)),
    "pitch": ((1.8, 0.39, 0.5), (0.7, 1.21, 1.3), (0.08, 8.9, 0.9)),
    "roll": ((2.6, 0.29, 2.8), (0.8, 0.89, 0.6), (0.06, 6.1, 1.7)),
}
"""Amplitude (metres or degrees), frequency (Hz) and phase (radians) of the sines of each coordinate.

The third sine of each is the tremor of the hand.
"""

R_WC_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Camera-to-world rotation of a level camera whose optical axis is +y of the world (x right, y forward, z up)."""


@dataclass(frozen=True)
class CameraTrajectory:
    """Trajectory of a hand-held camera about a rest pose that looks along +y of the world.

    Attributes:
        rest_position: Mean position of the camera, world frame, metres.
        rest_pitch: Mean pitch of the camera, degrees; negative is downwards.
        start: Time within the oscillations at which the sequence starts, seconds.
    """

    rest_position: tuple[float, float, float]
    rest_pitch: float
    start: float = 0.0

    def pose(self, t: float) -> NDArray[np.float64]:
        """Return the camera pose at a time.

        Args:
            t: Time since the start of the sequence, seconds.

        Returns:
            ``T_wc``, camera-to-world pose, float64, shape :math:`(4, 4)`.
        """
        t = t + self.start
        value = {
            name: sum(a * np.sin(2 * np.pi * f * t + phase) for a, f, phase in sines)
            for name, sines in _OSCILLATIONS.items()
        }
        angles = (value["yaw"], value["pitch"] + self.rest_pitch, value["roll"])
        # Intrinsic rotations: yaw about the vertical (positive to the left), then pitch (up), then roll (optical axis).
        rotation = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
        T_wc = np.eye(4)
        T_wc[:3, :3] = rotation @ R_WC_LEVEL
        T_wc[:3, 3] = np.add(self.rest_position, (value["x"], value["y"], value["z"]))
        return T_wc
