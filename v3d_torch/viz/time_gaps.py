"""Times without frames, at which all plots of a run are interrupted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

_MAX_INTERVAL = 5
"""Maximum interval between two frames without a gap, in median intervals: a live run drops some frames, and a curve
that is interrupted at each of them cannot be read."""


def find_gaps(seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the positions of the frames that follow a gap.

    Args:
        seconds: Time of each frame, increasing, shape :math:`(N,)`.
    """
    intervals = np.diff(seconds)
    if not len(intervals):
        return np.zeros(0, np.int64)
    return np.flatnonzero(intervals > _MAX_INTERVAL * np.median(intervals)) + 1


def insert_gaps(stamps: Tensor, points: Tensor) -> NDArray[np.float64]:
    """Insert a NaN into a curve at each gap, so that it is interrupted there.

    Args:
        stamps: Timestamps, seconds, increasing, shape :math:`(N,)`.
        points: Points of the curve, shape :math:`(N, 2)`.

    Returns:
        Points with the NaNs, shape :math:`(N + G, 2)`.
    """
    return np.insert(points.numpy(), find_gaps(stamps.numpy()), np.nan, axis=0)
