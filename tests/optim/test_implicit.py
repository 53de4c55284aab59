"""Derivatives of an optimum: Jacobians against autograd, a Newton step against the closed form."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import grad, vmap

from v3d_torch.geometry.gradients import needs_gradient, zero_with_gradient
from v3d_torch.optim.implicit import jacobian


def test_jacobian_of_rows_equals_autograd() -> None:
    x = torch.randn(3, 2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def function(x: Tensor) -> Tensor:
        return torch.stack([x.prod(dim=-1), x[..., 0].sin() * x[..., 1], x.square().sum(dim=-1)], dim=-1)

    expected = vmap(vmap(torch.func.jacrev(function)))(x)
    assert jacobian(function, x).shape == (3, 2, 3, 4)
    torch.testing.assert_close(jacobian(function, x), expected)


def test_newton_step_has_the_derivative_of_the_optimum() -> None:
    """The minimum of x^4 - a x is (a / 4)^(1 / 3)."""
    a = torch.tensor([0.5, 4.0, 20.0], dtype=torch.float64, requires_grad=True)
    x = (a.detach() / 4) ** (1 / 3)
    optimum = x + zero_with_gradient(-(4 * x**3 - a) / (12 * x**2))
    assert torch.equal(optimum, x)
    (derivative,) = torch.autograd.grad(optimum.sum(), a)
    torch.testing.assert_close(derivative, (a.detach() / 4) ** (-2 / 3) / 12)


def test_gradients_are_needed_for_inputs_with_gradients_and_inside_transforms() -> None:
    x = torch.ones(1)
    with_gradient = x.clone().requires_grad_()
    assert needs_gradient(x, with_gradient) and not needs_gradient(x)
    with torch.no_grad():
        assert not needs_gradient(with_gradient)
    seen = []
    grad(lambda y: (seen.append(needs_gradient(y)), y.sum())[1])(x)
    assert seen == [True]
    with torch.autograd.forward_ad.dual_level():
        assert needs_gradient(x)
