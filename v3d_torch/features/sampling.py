"""RANSAC in torch: many hypotheses from random samples, for a batch of problems on any device.

Fischler and Bolles, Random Sample Consensus, CACM 1981. The score is the truncated squared error (MSAC; Torr and
Zisserman, MLESAC, CVIU 2000).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from v3d_torch.config import OdometryConfig
from v3d_torch.geometry.argument_checks import check_counts, check_positive

ITERATIONS = OdometryConfig().iterations
"""Default number of hypotheses, that of the odometry section of the configuration."""

_CHUNK = 64
"""Number of samples tested at once; it bounds the memory."""


def find_best_hypothesis(
    solve: Callable[[Tensor], Tensor],
    squared_errors: Callable[[Tensor], Tensor],
    valid: Tensor,
    default: Tensor,
    *,
    size: int,
    threshold: float,
    iterations: int,
    seed: int,
) -> tuple[Tensor, Tensor]:
    """Find the hypothesis with the lowest sum of truncated squared errors.

    Args:
        solve: Function from samples, indices of shape :math:`(..., S, n)`, to hypotheses, matrices of shape
            :math:`(..., S, H, r, c)`, with H hypotheses per sample; NaN for hypotheses that do not exist.
        squared_errors: Function from hypotheses of shape :math:`(..., T, r, c)` to the squared error of each element,
            :math:`(..., T, N)`; infinite or NaN for elements that exclude the hypothesis.
        valid: Mask of the elements that are not padding, bool, shape :math:`(..., N)`.
        default: Result of problems without a hypothesis, shape :math:`(r, c)`.
        size: Number n of elements in a sample.
        threshold: Error at which errors are truncated, in the unit of the square root of the squared errors.
        iterations: Number of samples.
        seed: Seed of the sampling.

    Returns:
        The best hypothesis, shape :math:`(..., r, c)`, and a mask of the problems with one, bool, shape :math:`(...)`.
    """
    has_sample = valid.sum(dim=-1) >= size
    best = default.expand(*valid.shape[:-1], *default.shape)
    if valid.shape[-1] < size:
        return best, has_sample
    lowest = torch.full(valid.shape[:-1], torch.inf, dtype=default.dtype, device=default.device)
    for samples in draw_samples(valid, size, iterations, seed).split(_CHUNK, dim=-2):
        hypotheses = solve(samples).flatten(-4, -3)
        errors = squared_errors(hypotheses).nan_to_num(nan=torch.inf).clamp(max=threshold**2)
        costs = torch.where(valid[..., None, :], errors, 0.0).sum(dim=-1)
        costs = torch.where(hypotheses.isfinite().all(dim=(-2, -1)), costs, torch.inf)
        cost, index = costs.min(dim=-1)
        chosen = torch.take_along_dim(hypotheses, index[..., None, None, None], dim=-3)[..., 0, :, :]
        is_better = cost < lowest
        best, lowest = torch.where(is_better[..., None, None], chosen, best), torch.where(is_better, cost, lowest)
    found = lowest.isfinite() & has_sample
    return torch.where(found[..., None, None], best, default), found


def draw_samples(valid: Tensor, size: int, count: int, seed: int) -> Tensor:
    """Draw random samples without replacement, the same on every device.

    Args:
        valid: Mask of the elements that can be drawn, bool, shape :math:`(..., N)`. If fewer than ``size`` elements are
            valid, samples also contain others.
        size: Number n of elements in a sample, at most N.
        count: Number S of samples.
        seed: Seed of the sampling.

    Returns:
        Indices, int64, shape :math:`(..., S, n)`.
    """
    keys = _random_bits(count * valid.shape[-1], seed, valid.device).unflatten(0, (count, valid.shape[-1]))
    return torch.where(valid[..., None, :], keys, 2**32).topk(size, dim=-1, largest=False).indices


def _random_bits(count: int, seed: int, device: torch.device) -> Tensor:
    """Random numbers of 32 bits, int64, shape (count,).

    They are hashes of a counter (Wellons, Hash Prospector, 2018), because the random numbers of torch depend on the
    device and fail in `torch.func.vmap`.
    """
    mask, bits = 2**32 - 1, torch.arange(count, dtype=torch.int64, device=device) + seed * 0x9E3779B9 % 2**32
    for shift, factor in ((16, 0x21F0AAAD), (15, 0x735A2D97)):
        bits = (bits & mask) ^ ((bits & mask) >> shift)
        bits = bits * factor & mask
    return bits ^ (bits >> 15)


def check_limits(threshold: float, iterations: int) -> None:
    """Check the limits of a search.

    Args:
        threshold: Maximum error of an inlier.
        iterations: Maximum number of hypotheses.

    Raises:
        ConfigError: If one of them is not positive, or ``iterations`` is not a whole number.
    """
    check_positive(threshold=threshold, iterations=iterations)
    check_counts(iterations=iterations)


def gather_samples(elements: Tensor, samples: Tensor) -> Tensor:
    """Gather the elements at the indices of samples.

    Args:
        elements: Shape :math:`(..., N, d)`.
        samples: Indices, int64, shape :math:`(..., S, n)`.

    Returns:
        Shape :math:`(..., S, n, d)`.
    """
    index = samples.flatten(-2)[..., None].expand(*samples.shape[:-2], -1, elements.shape[-1])
    return elements.gather(-2, index).unflatten(-2, samples.shape[-2:])
