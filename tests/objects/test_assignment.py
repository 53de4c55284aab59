"""Assignment of instances to tracks by their log-likelihood ratios."""

from __future__ import annotations

from itertools import permutations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.errors import InputError
from v3d_torch.objects.assignment import match_instances


@given(st.lists(st.floats(0.1, 9.0), min_size=9, max_size=9))
def test_assignment_has_the_largest_sum_of_all_permutations(values: list[float]) -> None:
    ratio = torch.tensor(values, dtype=torch.float64).reshape(3, 3)
    matched = match_instances(ratio[None])[0]
    best = max(float(ratio[list(order), range(3)].sum()) for order in permutations(range(3)))
    assert abs(float(ratio[matched, torch.arange(3)].sum()) - best) < 1e-9


def test_pair_without_positive_ratio_is_not_matched() -> None:
    ratio = torch.tensor([[[0.0, -1.0, -torch.inf], [-torch.inf, -2.0, 0.5]]])
    assert match_instances(ratio).tolist() == [[-1, -1, 1]]


@pytest.mark.parametrize("ratio", [torch.nan, torch.inf])
def test_ratio_that_is_not_finite_is_rejected(ratio: float) -> None:
    with pytest.raises(InputError, match=r"^log_ratio has NaN or plus infinity; give finite ratios, or -inf for imp"):
        match_instances(torch.tensor([[[0.0, ratio], [1.0, 2.0]]]))


@pytest.mark.parametrize("padding", [torch.nan, torch.inf, -torch.inf])
def test_values_of_padding_have_no_effect(padding: float) -> None:
    ratio = torch.tensor([[[2.0, padding, 1.0], [padding, padding, padding], [3.0, padding, 2.5]]])
    tracked, present = torch.tensor([[True, False, True]]), torch.tensor([[True, False, True]])
    assert match_instances(ratio, tracked, present).tolist() == [[0, -1, 2]]
