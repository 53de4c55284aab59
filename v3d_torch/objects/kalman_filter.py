"""Kalman filter with constant velocity: position and velocity of an object from noisy centroids (paper, Sec. II)."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.objects.object_state import ObjectState

_INITIAL_SPEED_SIGMA = 1.0
"""Standard deviation of the initial velocity, m/s: a new object can be at rest or walk."""

_CENTROID_SIGMA = 0.04
"""Standard deviation of a measured centroid of the visible part, metres: noise of depth and of the contour."""

_SURFACE_SIGMA = 0.035
"""Standard deviation of the centroid of the surface in a refined mask, metres: such a mask misses fewer parts than the
cloud of an object."""

_SLOW_FRACTION, _SLOW_TIME = 0.5, 2.0
"""Fraction of the variance of the offset that changes slowly, because the same part is visible in consecutive frames,
and its time constant, seconds: within seconds a person turns, or others walk by. The rest differs in each frame,
because masks end at different places."""

_FACTOR_TIME, _FACTOR_PRIOR = 4.0, 5.0
"""Time constant of the variance factor, which is a running mean, seconds: a person walks in the same way for some
seconds. And weight of its initial value 1, in measurements; it decays like the weights of measurements."""

_MIN_FACTOR, _MAX_FACTOR = 0.05, 4.0
"""Range of the variance factor: someone who walks evenly can still turn, and a jump of the mask is no motion."""


class ConstantVelocityKalmanFilter:
    """Constant-velocity Kalman filter of one object, of which a changing part is visible.

    A measured centroid is that of the visible part, which has an offset from that of the whole object. One component of
    the offset is white noise. The other is a Gauss-Markov process (coloured measurement noise: Bar-Shalom, Li and
    Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, Sec. 8.4), and belongs to the state of
    the filter: as white noise, it would be confused with motion.

    The filter assumes more noise than most objects have, so that ids hold where masks jump and people turn. In the
    visible state, which users get, a variance factor therefore scales the variances of velocity and acceleration. It is
    the mean of the normalised squared innovations (same book, Sec. 5.4), which is 1 if the assumed noise is right. The
    variance of the position is not scaled, because its error is that of the mask.

    Args:
        config: Noise and maximum speed.

    Attributes:
        state: Estimate for the whole object after the last measurement, see `ObjectState`.
        visible_state: Estimate for its visible part, with the same velocity, whose covariance and acceleration noise
            are scaled by the variance factor.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._max_speed = config.max_speed
        position = torch.full((3,), torch.nan, dtype=torch.float64)
        velocity = torch.zeros_like(position)
        self.state = ObjectState(0.0, position, velocity, (1.0, 0.0, 1.0), config.acceleration_noise)
        self.visible_state = self.state
        self._offset = torch.zeros_like(position)  # its slow part
        self._offset_covariances = 0.0, 0.0, 0.0  # with position and velocity, and variance
        self._offset_sigma = 0.0
        self._squared_innovations, self._measurements = _FACTOR_PRIOR, _FACTOR_PRIOR  # sums with decaying weights

    def update(self, stamp: float, position: Tensor, sigma: float) -> None:
        """Update the state with a measured position of the visible part.

        Args:
            stamp: Timestamp, seconds, not before the last one.
            position: Measured position, world frame, metres, float64, shape :math:`(3,)`. NaN is ignored.
            sigma: Standard deviation of each coordinate of the offset of the visible part, metres.
        """
        if not all(map(math.isfinite, position.tolist())):
            return
        if self.state.is_known:
            self._predict(stamp, sigma)
            self._correct(position)
        else:
            self._start(stamp, position, sigma)

    def correct_visible_position(self, position: Tensor) -> None:
        """Replace the position in the visible state by the centroid of the surface in a refined mask, of the same time.

        It changes neither the estimate for the whole object nor later states: ids compare centroids of clouds.

        Args:
            position: Centroid of the surface, world frame, metres, float64, shape :math:`(3,)`.
        """
        pp, pv, vv = self.visible_state.variances
        variances = _SURFACE_SIGMA**2, pv * _SURFACE_SIGMA / math.sqrt(pp), vv
        self.visible_state = replace(self.visible_state, position=position, variances=variances)

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the state into the corrected world frame.

        Args:
            T_new_old: Transform from the old to the corrected world frame, float64, shape :math:`(4, 4)`.
        """
        self.state, self.visible_state = self.state.transform(T_new_old), self.visible_state.transform(T_new_old)
        self._offset = T_new_old[:3, :3] @ self._offset

    def _start(self, stamp: float, measured: Tensor, sigma: float) -> None:
        """Start with a measured position and without velocity."""
        variance, speed_variance = _CENTROID_SIGMA**2, _INITIAL_SPEED_SIGMA**2
        at_rest, noise = torch.zeros_like(measured), self.state.acceleration_noise
        self.state = ObjectState(stamp, measured, at_rest, (sigma**2 + variance, 0.0, speed_variance), noise)
        self.visible_state = ObjectState(stamp, measured, at_rest, (variance, 0.0, speed_variance), noise)
        slow = _SLOW_FRACTION * sigma**2
        self._offset_covariances, self._offset_sigma = (-slow, 0.0, slow), sigma

    def _predict(self, stamp: float, sigma: float) -> None:
        """Predict the state. The slow part of the offset decays, and scales with its standard deviation.

        The weights of earlier measurements in the variance factor decay as well.
        """
        dt, (po, vo, oo) = stamp - self.state.stamp, self._offset_covariances
        correlation = math.exp(-dt / _SLOW_TIME)
        scale = correlation * sigma / self._offset_sigma
        self.state = self.state.predict(stamp)
        self._offset = scale * self._offset
        variance = scale**2 * oo + (1 - correlation**2) * _SLOW_FRACTION * sigma**2
        self._offset_covariances, self._offset_sigma = (scale * (po + dt * vo), scale * vo, variance), sigma
        kept = math.exp(-dt / _FACTOR_TIME)
        self._squared_innovations, self._measurements = kept * self._squared_innovations, kept * self._measurements

    def _correct(self, measured: Tensor) -> None:
        """Correct the predicted state with a measurement: the sum of position, both parts of the offset, and noise."""
        (pp, pv, vv), (po, vo, oo) = self.state.variances, self._offset_covariances
        p, v, o = pp + po, pv + vo, po + oo  # covariances with the measurement
        variance = p + o + (1 - _SLOW_FRACTION) * self._offset_sigma**2 + _CENTROID_SIGMA**2
        innovation = measured - self.state.position - self._offset
        weighted = innovation / variance
        self._squared_innovations += float(innovation @ weighted) / len(innovation)  # 1 is expected
        self._measurements += 1
        factor = min(max(self._squared_innovations / self._measurements, _MIN_FACTOR), _MAX_FACTOR)
        position, velocity = self.state.position + p * weighted, self.state.velocity + v * weighted
        speed = math.hypot(*velocity.tolist())
        if speed > self._max_speed:
            velocity = velocity * (self._max_speed / speed)
        variances = pp - p * p / variance, pv - p * v / variance, vv - v * v / variance
        stamp, noise = self.state.stamp, self.state.acceleration_noise
        self.state = ObjectState(stamp, position, velocity, variances, noise)
        # The visible part is where it was measured, but for the noise of the measurement.
        noise_fraction = _CENTROID_SIGMA**2 / variance
        position_variance, covariance = _CENTROID_SIGMA**2 * (1 - noise_fraction), v * noise_fraction
        variances = position_variance, math.sqrt(factor) * covariance, factor * variances[2]
        position = measured - noise_fraction * innovation
        self.visible_state = ObjectState(stamp, position, velocity, variances, math.sqrt(factor) * noise)
        self._offset = self._offset + o * weighted
        self._offset_covariances = po - p * o / variance, vo - v * o / variance, oo - o * o / variance
