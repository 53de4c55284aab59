"""Kalman filter with constant velocity: position and velocity of an object from noisy centroids (paper, Sec. II)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.objects.object_state import ObjectState

_INITIAL_SPEED_SIGMA = 1.0
"""Standard deviation of the initial velocity, m/s: a new object can be at rest or walk."""

_MIN_SPEED = 1e-9
"""Lower bound of the speed as a divisor, m/s."""


class ConstantVelocityKalmanFilter:
    """Constant-velocity Kalman filter of one object, see `ObjectState`.

    Args:
        config: Noise and maximum speed.

    Attributes:
        state: Estimate after the last measurement.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._max_speed = config.max_speed
        position = torch.full((3,), torch.nan, dtype=torch.float64)
        velocity = torch.zeros_like(position)
        self.state = ObjectState(0.0, position, velocity, (1.0, 0.0, 1.0), config.acceleration_noise)

    def update(self, stamp: float, position: Tensor, sigma: float) -> None:
        """Update the state with a measured position.

        Args:
            stamp: Timestamp, seconds, not before the last one.
            position: Measured position, world frame, metres, float64, shape :math:`(3,)`. NaN is ignored.
            sigma: Standard deviation of each coordinate, metres.
        """
        if not bool(torch.isfinite(position).all()):
            return
        if self.state.is_known:
            self.state = self._correct(self.state.predict(stamp), position, sigma)
        else:
            variances = sigma**2, 0.0, _INITIAL_SPEED_SIGMA**2
            velocity = torch.zeros_like(position)
            self.state = replace(self.state, stamp=stamp, position=position, velocity=velocity, variances=variances)

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the state into the corrected world frame.

        Args:
            T_new_old: Transform from the old to the corrected world frame, float64, shape :math:`(4, 4)`.
        """
        self.state = self.state.transform(T_new_old)

    def _correct(self, predicted: ObjectState, position: Tensor, sigma: float) -> ObjectState:
        pp, pv, vv = predicted.variances
        position_gain, velocity_gain = pp / (pp + sigma**2), pv / (pp + sigma**2)
        innovation = position - predicted.position
        velocity = predicted.velocity + velocity_gain * innovation
        return replace(
            predicted,
            position=predicted.position + position_gain * innovation,
            velocity=velocity * min(1.0, self._max_speed / max(float(velocity.norm()), _MIN_SPEED)),
            variances=(pp - position_gain * pp, pv - position_gain * pv, vv - velocity_gain * pv),
        )
