"""State of an object: position and velocity with their covariance, and its prediction with constant velocity."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True)
class ObjectState:
    """Position and velocity of an object at one time, as its Kalman filter estimates them.

    The three axes are independent and have the same covariance, because the errors of centroids come from the visible
    part of the object and have no preferred direction.

    Attributes:
        stamp: Timestamp, seconds.
        position: Centroid of the object or of its visible part, world frame, metres, float64, shape :math:`(3,)`;
            NaN before the first centroid.
        velocity: World frame, m/s, float64, shape :math:`(3,)`; 0 before the second centroid.
        variances: Of each axis: variance of the position, covariance of position and velocity, variance of the
            velocity; square metres, m^2/s and m^2/s^2. Before the first centroid, those with which motion is expected.
        acceleration_noise: Square root of the spectral density of the acceleration, m/s^1.5: the uncertainty that a
            prediction adds.
    """

    stamp: float
    position: Tensor
    velocity: Tensor
    variances: tuple[float, float, float]
    acceleration_noise: float

    @cached_property
    def is_known(self) -> bool:
        """True once a centroid has been measured."""
        return all(map(math.isfinite, self.position.tolist()))

    @property
    def sigmas(self) -> tuple[float, float]:
        """Standard deviation of each coordinate of position, metres, and velocity, m/s; NaN without a centroid."""
        pp, _, vv = self._known_variances
        return math.sqrt(pp), math.sqrt(vv)

    @property
    def covariance(self) -> Tensor:
        """Covariance of position and velocity, in this order, float64, shape :math:`(6, 6)`; NaN without a centroid."""
        pp, pv, vv = self._known_variances
        of_axis = self.position.new_tensor([[pp, pv], [pv, vv]])
        return torch.kron(of_axis, torch.eye(3, dtype=self.position.dtype))

    @property
    def _known_variances(self) -> tuple[float, float, float]:
        """Variances; NaN without a centroid."""
        return self.variances if self.is_known else (math.nan, math.nan, math.nan)

    def predict(self, stamp: float) -> ObjectState:
        """Predict the state with constant velocity and white acceleration noise.

        Args:
            stamp: Timestamp, not earlier than that of the state, seconds.
        """
        if stamp == self.stamp:
            return self
        if not self.is_known:
            return replace(self, stamp=stamp)
        dt, noise = stamp - self.stamp, self.acceleration_noise**2
        pp, pv, vv = self.variances
        pp += 2 * dt * pv + dt**2 * vv + noise * dt**3 / 3
        variances = pp, pv + dt * vv + noise * dt**2 / 2, vv + noise * dt
        position = self.position + self.velocity * dt
        return ObjectState(stamp, position, self.velocity, variances, self.acceleration_noise)

    def motion_variance(self, seconds: float) -> float:
        """Return the variance of each coordinate of the motion in a time, relative to the prediction, square metres."""
        return seconds**2 * self.variances[2] + self.acceleration_noise**2 * seconds**3 / 3

    def predict_with_decay(self, stamp: float, time_constant: float) -> ObjectState:
        """Predict the state with a velocity that decays to zero, for longer times than `predict`.

        The velocity is an Ornstein-Uhlenbeck process, as in the target model of Singer (1970), but one derivative
        lower: the expected position converges, and its variance increases linearly instead of with the third power.

        Args:
            stamp: Timestamp, not earlier than that of the state, seconds.
            time_constant: Time in which the expected velocity decays to 1/e, seconds.
        """
        if not self.is_known:
            return replace(self, stamp=stamp)
        dt, (pp, pv, vv) = stamp - self.stamp, self.variances
        decay, noise = math.exp(-dt / time_constant), self.acceleration_noise**2
        reach = time_constant * (1 - decay)
        spread = time_constant * (time_constant * (dt - reach) - reach**2 / 2)
        variances = (
            pp + 2 * reach * pv + reach**2 * vv + noise * spread,
            decay * (pv + reach * vv) + noise * reach**2 / 2,
            decay**2 * vv + noise * time_constant * (1 - decay**2) / 2,
        )
        position, velocity = self.position + self.velocity * reach, self.velocity * decay
        return ObjectState(stamp, position, velocity, variances, self.acceleration_noise)

    def predict_at_rest(self, stamp: float) -> ObjectState:
        """Predict the state of an object that does not move: it is where it was, as accurately as it was known.

        Args:
            stamp: Timestamp, seconds.
        """
        variances = self.variances[0], 0.0, 0.0
        return ObjectState(stamp, self.position, torch.zeros_like(self.velocity), variances, self.acceleration_noise)

    def transform(self, T_new_old: Tensor) -> ObjectState:
        """Transform the state into another world frame; the covariance is the same in all of them.

        Args:
            T_new_old: Transform from the old to the new world frame, float64, shape :math:`(4, 4)`.
        """
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        return replace(self, position=R @ self.position + t, velocity=R @ self.velocity)
