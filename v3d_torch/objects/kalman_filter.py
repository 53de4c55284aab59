"""Kalman filter with constant velocity: position and velocity of an object from noisy centroids (paper, Sec. II)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig

_INITIAL_SPEED_SIGMA = 1.0
"""Standard deviation of the initial velocity, m/s: a new object can be at rest or walk."""

_MIN_SPEED = 1e-9
"""Lower bound of the speed as a divisor, m/s."""


class ConstantVelocityKalmanFilter:
    """Constant-velocity Kalman filter of one object; the three axes are independent and have the same covariance.

    Args:
        config: Noise and maximum speed.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._acceleration_noise = config.acceleration_noise
        self._max_speed = config.max_speed
        self._stamp = 0.0
        self._position = torch.full((3,), torch.nan, dtype=torch.float64)
        self._velocity = torch.zeros_like(self._position)
        self._covariance = (1.0, 0.0, 1.0)  # position variance, cross-covariance, velocity variance

    @property
    def velocity(self) -> Tensor:
        """Velocity, world frame, m/s, float64, shape :math:`(3,)`; 0 before the second measurement."""
        return self._velocity

    def predict(self, stamp: float) -> Tensor:
        """Predict the position at a timestamp.

        Args:
            stamp: Timestamp, seconds.

        Returns:
            Position, world frame, metres, float64, shape :math:`(3,)`; NaN before the first measurement.
        """
        return self._position + self._velocity * (stamp - self._stamp)

    def innovation(self, stamp: float, position: Tensor, sigma: float) -> tuple[Tensor, float]:
        """Compare a measured position with its prediction, without an update.

        Args:
            stamp: Timestamp, seconds, not before the last one.
            position: Measured position, world frame, metres, float64, shape :math:`(3,)`.
            sigma: Standard deviation of each coordinate, metres.

        Returns:
            Measured minus predicted position, metres, float64, shape :math:`(3,)`, and the variance of each coordinate,
            square metres.
        """
        return position - self.predict(stamp), self._predict_covariance(stamp)[0] + sigma**2

    def update(self, stamp: float, position: Tensor, sigma: float) -> None:
        """Update the state with a measured position.

        Args:
            stamp: Timestamp, seconds, not before the last one.
            position: Measured position, world frame, metres, float64, shape :math:`(3,)`. NaN is ignored.
            sigma: Standard deviation of each coordinate, metres.
        """
        if not bool(torch.isfinite(position).all()):
            return
        if bool(self._position.isnan().any()):
            self._position, self._velocity = position, torch.zeros_like(position)
            self._covariance = (sigma**2, 0.0, _INITIAL_SPEED_SIGMA**2)
        else:
            self._correct(stamp, position, sigma)
        self._stamp = stamp

    def _correct(self, stamp: float, position: Tensor, sigma: float) -> None:
        pp, pv, vv = self._predict_covariance(stamp)
        position_gain, velocity_gain = pp / (pp + sigma**2), pv / (pp + sigma**2)
        self._covariance = pp - position_gain * pp, pv - position_gain * pv, vv - velocity_gain * pv
        predicted = self.predict(stamp)
        innovation = position - predicted
        self._position = predicted + position_gain * innovation
        velocity = self._velocity + velocity_gain * innovation
        self._velocity = velocity * min(1.0, self._max_speed / max(float(velocity.norm()), _MIN_SPEED))

    def _predict_covariance(self, stamp: float) -> tuple[float, float, float]:
        """Predict the covariance with white acceleration noise."""
        dt, noise = stamp - self._stamp, self._acceleration_noise**2
        pp, pv, vv = self._covariance
        pp += 2 * dt * pv + dt**2 * vv + noise * dt**3 / 3
        return pp, pv + dt * vv + noise * dt**2 / 2, vv + noise * dt

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the state into the corrected world frame.

        Args:
            T_new_old: Transform from the old to the corrected world frame, float64, shape :math:`(4, 4)`.
        """
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        self._position, self._velocity = R @ self._position + t, R @ self._velocity
