r"""Derivatives of an optimum by the implicit function theorem.

An optimum :math:`x` of a cost with parameters :math:`\theta` is a root of the gradient :math:`g(x, \theta)`. Therefore

.. math::
    \frac{dx}{d\theta} = - \left( \frac{\partial g}{\partial x} \right)^{-1} \frac{\partial g}{\partial \theta}

independently of the steps that led to :math:`x`: they need not be stored, and the initial estimate has no influence
(Gould et al., On Differentiating Parameterized Argmin and Argmax Problems, 2016). :math:`\partial g / \partial x` is
the Hessian of the cost, not its Gauss-Newton approximation, so that the derivatives are exact even if residuals are not
0.

A solver finds the optimum without gradients. One Newton step from there, with the Hessian held constant, has the value
0 and the derivative above; see `v3d_torch.geometry.gradients`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import jvp, vmap


def jacobian(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Jacobians of a function from rows of its argument to rows of its result, by forward-mode differentiation.

    Args:
        function: Function from shape :math:`(..., n)` to shape :math:`(..., m)`.
        x: Arguments, shape :math:`(..., n)`.

    Returns:
        Shape :math:`(..., m, n)`.
    """
    basis = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    columns = vmap(lambda direction: jvp(function, (x,), (direction.expand_as(x),))[1])(basis)
    return columns.movedim(0, -1)
