"""What is said of a set of errors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Statistics:
    """Summary of errors, in their unit; ``std`` is that of the population, as in the benchmark's tools."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @staticmethod
    def of(errors: Tensor) -> Statistics:
        """Summarise errors, shape :math:`(N,)` with N >= 1."""
        return Statistics(
            rmse=errors.square().mean().sqrt().item(),
            mean=errors.mean().item(),
            median=errors.quantile(0.5).item(),
            std=errors.std(correction=0).item(),
            min=errors.min().item(),
            max=errors.max().item(),
        )
