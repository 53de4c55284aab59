"""Kalman filter with constant velocity: position and velocity of an object from biased centroids (paper, Sec. II).

The centroid of an object is not a measurement with independent errors: a leg that swings, or a part that the mask cuts
off, shifts it for a while. Therefore the state has a third part, the bias of the centroid, a Gauss-Markov process. Its
size depends on how much of the object is hidden. Without it, the filter would trust ten equal centroids ten times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import TrackerConfig

_MEASUREMENT_SIGMA = 0.007
"""Standard deviation of the part of a centroid's error that is independent from frame to frame, metres."""

_BIAS_TIME = 0.5
"""Correlation time of the bias, seconds: about half a step of a walking person."""

_INITIAL_SPEED_SIGMA = 1.0
"""Standard deviation of the initial velocity, m/s: a new object is as likely to move at walking speed as to rest."""

_MIN_SPEED = 1e-9
"""Lower bound of a divisor, m/s."""

_MIN_SIGMA = 1e-9
"""Lower bound of a divisor, metres."""


@dataclass(frozen=True)
class StateEstimate:
    """Position and velocity of an object with their covariance.

    Attributes:
        position: Position, world frame, metres, float64, shape :math:`(3,)`; NaN if unknown.
        velocity: Velocity, world frame, m/s, float64, shape :math:`(3,)`.
        covariance: Covariance of position and velocity, in this order, float64, shape :math:`(6, 6)`.
    """

    position: Tensor
    velocity: Tensor
    covariance: Tensor


class ConstantVelocityKalmanFilter:
    """Position, velocity and centroid bias of one object. The three axes are independent, with the same covariance.

    Args:
        config: Noise and maximum speed.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._acceleration_noise = config.acceleration_noise
        self._max_speed = config.max_speed
        self._stamp = 0.0
        self._bias_sigma = 0.0
        # One row per part of the state: position, velocity, bias.
        self._state = torch.zeros(3, 3, dtype=torch.float64)
        self._state[0] = torch.nan
        self._covariance = torch.diag(torch.tensor([1.0, _INITIAL_SPEED_SIGMA**2, 1.0], dtype=torch.float64))

    @property
    def is_located(self) -> bool:
        """True after the first measurement."""
        return not math.isnan(float(self._state[0, 0]))

    @property
    def velocity(self) -> Tensor:
        """Velocity, world frame, m/s, float64, shape :math:`(3,)`; 0 before the second measurement."""
        return self._state[1]

    def predict(self, stamp: float) -> Tensor:
        """Predict the position at a timestamp.

        Args:
            stamp: Timestamp, seconds.

        Returns:
            Position, world frame, metres, float64, shape :math:`(3,)`; NaN before the first measurement.
        """
        return self._state[0] + self._state[1] * (stamp - self._stamp)

    def predict_state(self, stamp: float) -> StateEstimate:
        """Predict position and velocity with their covariance.

        Args:
            stamp: Timestamp, seconds.
        """
        state, covariance = self._predict(stamp, self._bias_sigma)
        blocks = np.kron(covariance[:2, :2], np.eye(3))
        return StateEstimate(*torch.from_numpy(state[:2]), torch.from_numpy(blocks))

    def innovation(self, stamp: float, position: Tensor, bias_sigma: float) -> tuple[Tensor, float]:
        """Compare a measurement with its prediction, without an update.

        Args:
            stamp: Timestamp, seconds, not before the last one.
            position: Measured position, world frame, metres, float64, shape :math:`(3,)`.
            bias_sigma: Standard deviation of the bias of each coordinate, metres.

        Returns:
            Measured minus predicted position, metres, float64, shape :math:`(3,)`, and the variance of each coordinate,
            square metres.
        """
        state, covariance = self._predict(stamp, bias_sigma)
        return position - torch.from_numpy(state[0] + state[2]), _innovation_variance(covariance)

    def update(self, stamp: float, position: Tensor, bias_sigma: float) -> None:
        """Update the state with a measured position.

        Args:
            stamp: Timestamp, seconds, not before the last one.
            position: Measured position, world frame, metres, float64, shape :math:`(3,)`. NaN is ignored.
            bias_sigma: Standard deviation of the bias of each coordinate, metres.
        """
        if not bool(torch.isfinite(position).all()):
            return
        if not self.is_located:
            variance = bias_sigma**2
            state = np.stack([position.numpy(), np.zeros(3), np.zeros(3)])
            covariance = np.diag([variance + _MEASUREMENT_SIGMA**2, _INITIAL_SPEED_SIGMA**2, variance])
            covariance[0, 2] = covariance[2, 0] = -variance  # the sum of position and bias was measured
        else:
            state, covariance = self._predict(stamp, bias_sigma)
            gain = (covariance[:, 0] + covariance[:, 2]) / _innovation_variance(covariance)
            state += gain[:, None] * (position.numpy() - state[0] - state[2])
            covariance -= np.outer(gain, gain) * _innovation_variance(covariance)
            state[1] *= min(1.0, self._max_speed / max(float(np.linalg.norm(state[1])), _MIN_SPEED))
        self._state, self._covariance = torch.from_numpy(state), torch.from_numpy(covariance)
        self._stamp, self._bias_sigma = stamp, bias_sigma

    def shift(self, offset: Tensor) -> None:
        """Redefine which point of the object is its position, without a motion.

        Args:
            offset: New minus old point, world frame, metres, float64, shape :math:`(3,)`.
        """
        self._state = torch.stack([self._state[0] + offset, *self._state[1:]])

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the state into the corrected world.

        Args:
            T_new_old: Transform from the old to the corrected world, float64, shape :math:`(4, 4)`.
        """
        rotated = self._state @ T_new_old[:3, :3].T
        self._state = torch.stack([rotated[0] + T_new_old[:3, 3], *rotated[1:]])

    def _predict(self, stamp: float, bias_sigma: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict state (3, 3) and covariance (3, 3) for a measurement with a bias of the given size."""
        dt, noise = stamp - self._stamp, self._acceleration_noise**2
        # What is left of the old bias. If less of the object is hidden than before, the bias shrinks as well.
        kept = math.exp(-dt / _BIAS_TIME) * min(1.0, bias_sigma / max(self._bias_sigma, bias_sigma, _MIN_SIGMA))
        transition = np.array([[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, kept]])
        process = np.zeros((3, 3))
        process[:2, :2] = noise * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])  # white acceleration noise
        process[2, 2] = bias_sigma**2 * (1 - math.exp(-2 * dt / _BIAS_TIME))
        if bias_sigma > self._bias_sigma:  # more is hidden than before
            process[2, 2] += (bias_sigma - self._bias_sigma) ** 2
        return transition @ self._state.numpy(), transition @ self._covariance.numpy() @ transition.T + process


def _innovation_variance(covariance: NDArray[np.float64]) -> float:
    """Return the variance of a measured coordinate: position plus bias plus independent error."""
    return float(covariance[0, 0] + 2 * covariance[0, 2] + covariance[2, 2]) + _MEASUREMENT_SIGMA**2
