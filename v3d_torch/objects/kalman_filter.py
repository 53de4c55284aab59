"""Where an object is and how fast, from noisy centroids: a Kalman filter with constant velocity (paper, Sec. II)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig


class ConstantVelocityKalmanFilter:
    """Position and velocity of one object, each axis alike and apart from the others.

    Args:
        config: noise and the greatest speed.
    """

    _SPEED_SIGMA = 1.0  # m/s: of what is seen for the first time, any walking speed is as likely as none

    def __init__(self, config: TrackerConfig) -> None:
        self._acceleration = config.acceleration_noise
        self._max_speed = config.max_speed
        self._stamp = 0.0
        self._place = torch.full((3,), torch.nan, dtype=torch.float64)
        self._velocity = torch.zeros_like(self._place)
        self._covariance = (1.0, 0.0, 1.0)  # of place, of both, of velocity: the same for all three axes

    @property
    def velocity(self) -> Tensor:
        """World frame, m/s, float64, shape :math:`(3,)`; 0 until two places are known."""
        return self._velocity

    def predict(self, stamp: float) -> Tensor:
        """Place at ``stamp``, world frame, metres, float64, shape :math:`(3,)`; nan while none was seen."""
        return self._place + self._velocity * (stamp - self._stamp)

    def update(self, stamp: float, place: Tensor, sigma: float) -> None:
        """Take in where the object was seen.

        Args:
            stamp: seconds, not before the last one.
            place: world frame, metres, float64, shape :math:`(3,)`; nan changes nothing.
            sigma: standard deviation of each coordinate, metres.
        """
        if not bool(torch.isfinite(place).all()):
            return
        if bool(self._place.isnan().any()):
            self._place, self._velocity = place, torch.zeros_like(place)
            self._covariance = (sigma**2, 0.0, self._SPEED_SIGMA**2)
        else:
            self._correct(stamp, place, sigma)
        self._stamp = stamp

    def _correct(self, stamp: float, place: Tensor, sigma: float) -> None:
        dt, noise = stamp - self._stamp, self._acceleration**2
        pp, pv, vv = self._covariance
        pp += 2 * dt * pv + dt**2 * vv + noise * dt**3 / 3
        pv += dt * vv + noise * dt**2 / 2
        vv += noise * dt
        of_place, of_velocity = pp / (pp + sigma**2), pv / (pp + sigma**2)  # the gains
        self._covariance = pp - of_place * pp, pv - of_place * pv, vv - of_velocity * pv
        expected = self.predict(stamp)
        surprise = place - expected
        self._place = expected + of_place * surprise
        velocity = self._velocity + of_velocity * surprise
        self._velocity = velocity * min(1.0, self._max_speed / max(float(velocity.norm()), 1e-9))

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry the state along when the map is corrected under it, see `InstanceTracker.move_world`."""
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        self._place, self._velocity = R @ self._place + t, R @ self._velocity
