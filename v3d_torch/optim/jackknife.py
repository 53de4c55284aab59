"""Uncertainty of least-squares estimates from data with correlated errors: the grouped jackknife."""

from __future__ import annotations

import torch
from torch import Tensor

MIN_GROUPS = 4
"""Smallest number of groups with a finite covariance: the t-distribution of fewer has none."""


def jackknife_covariance(gradient: Tensor, hessian: Tensor) -> Tensor:
    r"""Covariance of the minimum of a cost that is a sum over groups of observations.

    Observations of a group, such as those of one image, have common errors: motion blur, an inaccurate velocity. The
    inverse Hessian, which takes all errors as independent, is then far too small. The jackknife observes how the
    minimum changes when one group is left out (Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982).
    Here each change is one Newton step, :math:`(H - H_k)^{-1} g_k` with the gradient and the Hessian of the group at
    the minimum, which makes it a covariance that is robust to correlation and to influential groups (MacKinnon and
    White, Journal of Econometrics 1985; Bell and McCaffrey, Survey Methodology 2002).

    Args:
        gradient: First derivatives of each group's cost, float64, shape :math:`(K, C)`. Near the minimum of the sum,
            the second derivatives move them there.
        hessian: Second derivatives of each group's cost, float64, shape :math:`(K, C, C)`.

    Returns:
        Covariance of the minimum, shape :math:`(C, C)`. It includes the factor :math:`\nu / (\nu - 2)` of a
        t-distribution with :math:`\nu` = number of groups minus 1. Infinite if there are fewer than `MIN_GROUPS` groups
        with information, or if one group has all of the information on a parameter.
    """
    total = hessian.sum(dim=0)
    unknown = torch.full_like(total, torch.inf)
    groups = int((hessian.diagonal(dim1=1, dim2=2) > 0).any(dim=1).sum())
    rest = total - hessian
    if groups < MIN_GROUPS or not bool((torch.linalg.eigvalsh(rest)[:, 0] > 0).all()):
        return unknown
    step = torch.linalg.solve(total, -gradient.sum(dim=0))
    change = torch.linalg.solve(rest, gradient + hessian @ step)
    return (groups - 1) / groups * (groups - 1) / (groups - 3) * (change.T @ change)
