"""The growable table against concatenated tensors."""

from __future__ import annotations

import pytest
import torch
from helpers.sparse_maps import uniform
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.runtime.tensor_table import TensorTable


@settings(max_examples=30)
@given(st.lists(st.integers(0, 300), max_size=8))
def test_table_contains_all_appended_rows(counts: list[int]) -> None:
    table = TensorTable(number=((), torch.int64), position=((2,), torch.float64))
    expected = torch.zeros(0, 2, dtype=torch.float64)
    for seed, count in enumerate(counts):
        positions = uniform(count, 2, seed=seed)
        rows = table.append(number=torch.arange(count), position=positions)
        assert rows.tolist() == list(range(len(expected), len(expected) + count))
        expected = torch.cat([expected, positions])
    assert len(table) == len(expected)
    assert torch.equal(table["position"], expected)
    assert table["number"].tolist() == [number for count in counts for number in range(count)]


def test_writing_to_a_column_changes_the_table_and_incomplete_rows_are_rejected() -> None:
    table = TensorTable(number=((), torch.int64), flag=((), torch.bool))
    table.append(number=torch.arange(3), flag=torch.zeros(3, dtype=torch.bool))
    table["number"][1] = 7
    assert table["number"].tolist() == [0, 7, 2]
    with pytest.raises(KeyError, match="flag"):
        table.append(number=torch.arange(3))
    assert len(table) == 3
