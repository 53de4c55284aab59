"""Inverse sensor model of the occupancy map: log-odds of hits and misses as whole numbers of steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

from v3d_torch.config import OccupancyConfig

_MAX_STEPS = 127
"""Maximum log-odds of a voxel of 8 bits, steps."""


@dataclass(frozen=True)
class SensorModel:
    r"""Log-odds :math:`\log \frac{p}{1 - p}` in steps.

    Log-odds are whole numbers of steps, so that sums have no rounding errors and a voxel takes one byte.

    Attributes:
        hit: Log-odds of a hit, steps, at least 1.
        miss: Log-odds of a miss, steps, at most -1.
        minimum: Smallest log-odds of a voxel, steps.
        maximum: Largest log-odds of a voxel, steps.
        step: Log-odds of a step.
    """

    hit: int
    miss: int
    minimum: int
    maximum: int
    step: float

    @staticmethod
    def from_config(config: OccupancyConfig) -> SensorModel:
        """Return the sensor model of a configuration."""
        low, high = logit(config.min_probability), logit(config.max_probability)
        step = max(-low, high) / _MAX_STEPS
        return SensorModel(
            hit=max(round(logit(config.hit_probability) / step), 1),
            miss=min(round(logit(config.miss_probability) / step), -1),
            minimum=round(low / step),
            maximum=round(high / step),
            step=step,
        )


def logit(probability: float) -> float:
    """Log-odds of a probability."""
    return math.log(probability / (1 - probability))
