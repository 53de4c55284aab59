"""Robust losses: costs and weights of squared errors, in which large errors count less."""

from __future__ import annotations

import torch
from torch import Tensor

_SCALE_ITERATIONS = 10
"""Fixed-point iterations for the scale of a t-distribution; each one reduces the error by a constant factor."""


def huber(squared: Tensor, threshold: Tensor | float) -> tuple[Tensor, Tensor]:
    r"""Huber's loss on squared errors: quadratic up to the threshold, linear beyond.

    .. math::
        \rho(s) = s \;\text{if}\; s \le k^2, \; 2 k \sqrt{s} - k^2 \;\text{otherwise}

    Huber, Robust estimation of a location parameter, Annals of Mathematical Statistics, 1964.

    Args:
        squared: Squared errors :math:`s`, any shape.
        threshold: Squared error :math:`k^2` at which the loss turns linear, a number or one for each error.

    Returns:
        Costs :math:`\rho(s)` and weights :math:`d\rho / ds`, both of the shape of ``squared``.
    """
    is_linear = squared > threshold
    # torch.where evaluates both branches: the 1 keeps the unused branch and its gradient finite.
    weights = torch.where(is_linear, threshold / torch.where(is_linear, squared, 1.0), 1.0).sqrt()
    return squared * weights * (2 - weights), weights  # beyond the threshold, squared * weights^2 equals the threshold


def student_t(squared: Tensor, degrees_of_freedom: float) -> tuple[Tensor, Tensor]:
    r"""Robust loss of the t-distribution, whose heavy tails model outliers (Kerl et al., ICRA 2013).

    .. math::
        \rho(s) = (\nu + 1) \log(1 + s / \nu), \qquad \rho'(s) = \frac{\nu + 1}{\nu + s}

    Args:
        squared: Squared errors :math:`s` in units of the scale :math:`\sigma^2`, any shape.
        degrees_of_freedom: Degrees of freedom :math:`\nu`.

    Returns:
        Costs :math:`\rho(s)`, twice the negative log-likelihood up to a constant, and weights :math:`d\rho / ds`, both
        of the shape of ``squared``.
    """
    costs = (degrees_of_freedom + 1) * torch.log1p(squared / degrees_of_freedom)
    return costs, (degrees_of_freedom + 1) / (degrees_of_freedom + squared)


def student_t_scale(squared: Tensor, degrees_of_freedom: float) -> Tensor:
    r"""Maximum-likelihood scale of a t-distribution, by fixed-point iteration (Kerl et al., ICRA 2013).

    .. math::
        \sigma^2 \leftarrow \frac{1}{M} \sum_i r_i^2\, \frac{\nu + 1}{\nu + r_i^2 / \sigma^2}

    Args:
        squared: Squared errors :math:`r_i^2`, shape :math:`(M,)`, at least one.
        degrees_of_freedom: Degrees of freedom :math:`\nu`.

    Returns:
        Scale :math:`\sigma`, in the unit of the errors, shape :math:`()`.
    """
    variance = squared.mean()
    for _ in range(_SCALE_ITERATIONS):
        weights = student_t(squared / variance.clamp(min=1e-12), degrees_of_freedom)[1]
        variance = (weights * squared).mean()
    return variance.sqrt()
