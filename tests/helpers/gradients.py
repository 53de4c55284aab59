"""Checks of derivatives of optima."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def check_gradients(
    function: Callable[..., Tensor], *inputs: Tensor, step: float = 1e-3, tolerance: float = 1e-4
) -> bool:
    """Compare gradients with finite differences in random directions.

    A minimum of a cost is known to half of the digits, so that the steps are larger than those for a formula.
    """
    arguments = [each.detach().clone().requires_grad_() for each in inputs]
    return torch.autograd.gradcheck(
        function, arguments, eps=step, atol=tolerance, rtol=1e-2, fast_mode=True, nondet_tol=1e-9
    )


def count_graph_nodes(result: Tensor) -> int:
    """Number of operations that are kept in memory for the gradient of a result."""
    pending, nodes = [result.grad_fn], set()
    while pending:
        node = pending.pop()
        if node is not None and node not in nodes:
            nodes.add(node)
            pending += [parent for parent, _ in node.next_functions]
    return len(nodes)
