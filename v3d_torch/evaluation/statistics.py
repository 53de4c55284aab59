"""Summary statistics of errors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Statistics:
    """Summary statistics of errors, in the unit of the errors.

    ``std`` is the population standard deviation, as in the TUM benchmark's tools.
    """

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @staticmethod
    def of(errors: Tensor) -> Statistics:
        """Compute the statistics of errors, shape :math:`(N,)` with N >= 1."""
        return Statistics(
            rmse=errors.square().mean().sqrt().item(),
            mean=errors.mean().item(),
            median=errors.quantile(0.5).item(),
            std=errors.std(correction=0).item(),
            min=errors.min().item(),
            max=errors.max().item(),
        )
