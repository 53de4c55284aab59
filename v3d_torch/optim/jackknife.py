"""Uncertainty of least-squares estimates from data with correlated errors: the block jackknife."""

from __future__ import annotations

import math
from typing import NamedTuple

import scipy
import torch
from torch import Tensor

MAX_BLOCKS = 10
"""Maximum number of blocks. With ten blocks, the standard deviation is accurate to a quarter of itself, and the blocks
are long enough for their errors to be nearly uncorrelated."""

MIN_BLOCKS = 4
"""Minimum number of blocks: with fewer, the variance of the t-distribution is not finite."""


class Jackknife(NamedTuple):
    r"""Covariance of an estimate, and the number of blocks from which it comes.

    Attributes:
        covariance: Covariance, float64, shape :math:`(C, C)`. It includes the factor :math:`\nu / (\nu - 2)` of a
            t-distribution with :math:`\nu` = number of blocks minus 1. Infinite if there are fewer than `MIN_BLOCKS`
            groups with information, or if one block has all of the information on a parameter.
        blocks: Number of blocks.
    """

    covariance: Tensor
    blocks: int


def jackknife_covariance(gradient: Tensor, hessian: Tensor, max_blocks: int = MAX_BLOCKS) -> Jackknife:
    r"""Covariance of the minimum of a cost that is a sum over groups of observations.

    Observations of a group, such as those of one image, have common errors: motion blur, an inaccurate velocity.
    Successive groups observe the same landmarks. The inverse Hessian, which assumes independent errors, is then far
    too small. The jackknife computes how the minimum changes when a block of successive groups is left out
    (Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982; Kuensch, Annals of Statistics 1989). Here
    each change is one Newton step, :math:`(H - H_k)^{-1} g_k` with the gradient and the Hessian of the block at the
    minimum, so that influential blocks count in full (Bell and McCaffrey, Survey Methodology 2002).

    Args:
        gradient: First derivatives of each group's cost, in the order of time, float64, shape :math:`(K, C)`. The point
            at which they are taken need not be the minimum: the second derivatives move them to it.
        hessian: Second derivatives of each group's cost, float64, shape :math:`(K, C, C)`.
        max_blocks: Maximum number of blocks; fewer are longer, so that errors that last longer count.

    Returns:
        Covariance of the minimum, and the number of blocks.
    """
    informative = (hessian.diagonal(dim1=1, dim2=2) > 0).any(dim=1)
    gradient, hessian = (_sum_blocks(each[informative], max_blocks) for each in (gradient, hessian))
    total, blocks = hessian.sum(dim=0), len(hessian)
    rest = total - hessian
    if blocks < MIN_BLOCKS or not bool((torch.linalg.eigvalsh(rest)[:, 0] > 0).all()):
        return Jackknife(torch.full_like(total, torch.inf), blocks)
    step = torch.linalg.solve(total, -gradient.sum(dim=0))
    change = torch.linalg.solve(rest, gradient + hessian @ step)
    return Jackknife((blocks - 1) / blocks * (blocks - 1) / (blocks - 3) * (change.T @ change), blocks)


def p_value(difference: Tensor, covariance: Tensor, known: Tensor, blocks: int) -> float:
    r"""Probability that a difference between an estimate and the truth as large as this one occurs by chance.

    A covariance from few blocks is itself uncertain, so that the quadratic form of the difference has the distribution
    of Hotelling's :math:`T^2` (Annals of Mathematical Statistics 1931) and not a chi-squared distribution. If a part of
    the covariance is known, the degrees of freedom are those of Welch (Biometrika 1947) and Satterthwaite (Biometrics
    Bulletin 1946) along the difference.

    Args:
        difference: Estimate minus truth, float64, shape :math:`(C,)`.
        covariance: Covariance of the estimate by `jackknife_covariance`, float64, shape :math:`(C, C)`.
        known: Covariance of other, independent errors, float64, shape :math:`(C, C)`.
        blocks: Number of blocks of the covariance.

    Returns:
        From 0 to 1; 1 if there are not more blocks than parameters, whose covariance is then singular; NaN if the
        difference or the covariance is not finite.
    """
    if not (difference.isfinite().all() and covariance.isfinite().all()):  # so is that of too few blocks
        return math.nan
    count, of_blocks = len(difference), blocks - 1  # degrees of freedom
    if of_blocks < count:
        return 1.0
    uncertain = covariance * ((of_blocks - 2) / of_blocks)
    weighted = torch.linalg.solve(uncertain + known, difference)
    squared = max(float(difference @ weighted), 0.0)
    if squared == 0:
        return 1.0
    share = float(weighted @ uncertain @ weighted) / squared
    freedom = of_blocks / max(share, 1e-6) ** 2
    rest = freedom - count + 1
    return float(scipy.special.fdtrc(count, rest, squared * rest / (freedom * count)))


def _sum_blocks(values: Tensor, max_blocks: int) -> Tensor:
    """Sums over blocks of successive rows."""
    blocks = min(len(values), max_blocks)
    block = torch.arange(len(values)) * blocks // max(len(values), 1)
    return values.new_zeros(blocks, *values.shape[1:]).index_add_(0, block, values)
