"""Association of estimated poses with ground-truth poses by timestamp."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.io.timestamps import associate
from v3d_torch.types import Trajectory

MAX_TIME_DIFFERENCE = 0.02
"""Maximum difference between the timestamps of a pair, seconds. The default of the TUM benchmark's tools."""


@dataclass(frozen=True)
class Matches:
    """Pairs of ground-truth and estimated poses, one to one, in the order of the estimate.

    Attributes:
        groundtruth: Indices into the ground truth, int64, shape :math:`(M,)`.
        estimate: Indices into the estimate, int64, shape :math:`(M,)`.
    """

    groundtruth: Tensor
    estimate: Tensor

    def __len__(self) -> int:
        return self.estimate.shape[0]


def associate_trajectories(
    groundtruth: Trajectory, estimate: Trajectory, max_time_difference: float = MAX_TIME_DIFFERENCE
) -> Matches:
    """Associate poses by nearest timestamps, the nearest pair first, as the TUM benchmark's ``associate.py`` does.

    Args:
        groundtruth: Ground-truth poses.
        estimate: Estimated poses.
        max_time_difference: Maximum difference between the timestamps of a pair, seconds.
    """
    pairs = associate(estimate.stamps.tolist(), groundtruth.stamps.tolist(), max_time_difference)
    indices = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)
    return Matches(groundtruth=indices[:, 1], estimate=indices[:, 0])
