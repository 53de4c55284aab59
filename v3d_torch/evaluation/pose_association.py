"""Which pose of the estimate belongs to which of the ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.io.timestamps import associate
from v3d_torch.types import Trajectory

MAX_TIME_DIFFERENCE = 0.02
"""Stamps farther apart than this are no pair, seconds (the benchmark's own choice)."""


@dataclass(frozen=True)
class Matches:
    """Poses of the same time, one to one, in order of the estimate.

    Attributes:
        groundtruth: indices into the ground truth, int64, shape :math:`(M,)`.
        estimate: indices into the estimate, int64, shape :math:`(M,)`.
    """

    groundtruth: Tensor
    estimate: Tensor

    def __len__(self) -> int:
        return self.estimate.shape[0]


def match(groundtruth: Trajectory, estimate: Trajectory, max_time_difference: float = MAX_TIME_DIFFERENCE) -> Matches:
    """Pair poses by nearest stamps, the nearest pair first, as the TUM benchmark's ``associate.py`` does.

    Args:
        groundtruth: poses of the reference.
        estimate: poses to be judged.
        max_time_difference: farther stamps are no pair, seconds.
    """
    pairs = associate(estimate.stamps.tolist(), groundtruth.stamps.tolist(), max_time_difference)
    indices = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)
    return Matches(groundtruth=indices[:, 1], estimate=indices[:, 0])
