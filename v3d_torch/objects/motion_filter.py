"""Where an object is and how fast, from noisy centroids: a Kalman filter with constant velocity (paper, Sec. II)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import IdentityConfig


class MotionFilter:
    """Position and velocity of one object, each axis alike and apart from the others.

    Args:
        config: noise and the greatest speed.
    """

    _SPEED_SIGMA = 1.0  # m/s: of what is seen for the first time, any walking speed is as likely as none

    def __init__(self, config: IdentityConfig) -> None:
        self._acceleration = config.acceleration_noise
        self._max_speed = config.max_speed
        self._stamp = 0.0
        self._state = torch.stack([torch.full((3,), torch.nan), torch.zeros(3)]).to(torch.float64)
        self._covariance = torch.eye(2, dtype=torch.float64)  # of (position, velocity), the same for all three axes

    @property
    def velocity(self) -> Tensor:
        """World frame, m/s, float64, shape :math:`(3,)`; 0 until two places are known."""
        return self._state[1]

    def predict(self, stamp: float) -> Tensor:
        """Place at ``stamp``, world frame, metres, float64, shape :math:`(3,)`; nan while none was seen."""
        return self._state[0] + self._state[1] * (stamp - self._stamp)

    def update(self, stamp: float, place: Tensor, sigma: float) -> None:
        """Take in where the object was seen.

        Args:
            stamp: seconds, not before the last one.
            place: world frame, metres, float64, shape :math:`(3,)`; nan changes nothing.
            sigma: standard deviation of each coordinate, metres.
        """
        if not bool(torch.isfinite(place).all()):
            return
        if bool(self._state[0].isnan().any()):
            self._state = torch.stack([place, torch.zeros_like(place)])
            self._covariance = torch.tensor([sigma**2, self._SPEED_SIGMA**2], dtype=torch.float64).diag()
        else:
            self._correct(stamp - self._stamp, place, sigma)
        self._stamp = stamp

    def _correct(self, dt: float, place: Tensor, sigma: float) -> None:
        transition = torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=torch.float64)
        noise = torch.tensor([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], dtype=torch.float64)
        state = transition @ self._state
        covariance = transition @ self._covariance @ transition.T + self._acceleration**2 * noise
        gain = covariance[:, 0] / (covariance[0, 0] + sigma**2)
        self._state = state + torch.outer(gain, place - state[0])
        self._covariance = covariance - torch.outer(gain, covariance[0])
        self._state[1] *= min(1.0, self._max_speed / max(float(self._state[1].norm()), 1e-9))

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry the state along when the map is corrected under it, see `InstanceTracker.move_world`."""
        self._state = self._state @ T_new_old[:3, :3].T
        self._state[0] += T_new_old[:3, 3]
