"""Direction of gravity from the measurements of an accelerometer."""

from __future__ import annotations

import logging

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_LOG = logging.getLogger(__name__)

STANDARD_GRAVITY = 9.80665
"""Acceleration of gravity, m/s^2."""

_MAX_NORM_ERROR = 1.0
"""Maximum difference between the mean acceleration and gravity, m/s^2. Up to it, the bias of the sensor (0.05 g) and
the motion of a hand tilt the direction by some degrees; beyond it, the camera falls or swings, or the unit is wrong."""


def gravity_direction(accelerations: NDArray[np.float64], source: object) -> Tensor | None:
    """Estimate the direction of gravity from the accelerations measured around the first frame.

    Args:
        accelerations: Accelerations as an accelerometer measures them (at rest they point up), camera frame, m/s^2,
            shape :math:`(N, 3)`.
        source: Name of the source, for the log.

    Returns:
        Unit vector that points down, camera frame, float64, shape :math:`(3,)`. None without measurements, or if their
        mean is not that of a camera at rest; this is logged.
    """
    measured = accelerations[np.isfinite(accelerations).all(axis=1)]
    if not len(measured):
        return None
    mean = measured.mean(axis=0)
    norm = float(np.linalg.norm(mean))
    if abs(norm - STANDARD_GRAVITY) > _MAX_NORM_ERROR:
        _LOG.warning(
            "%s: the accelerometer measures %.2f m/s^2 at the first frame instead of %.2f; gravity is not used",
            source, norm, STANDARD_GRAVITY,
        )  # fmt: skip
        return None
    return torch.from_numpy(-mean / norm)
