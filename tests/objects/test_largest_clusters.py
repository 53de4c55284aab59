"""Largest clusters against counting in Python."""

from __future__ import annotations

from collections import Counter

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.errors import InputError
from v3d_torch.objects.largest_clusters import largest_clusters


@given(
    labels=st.lists(st.integers(-1, 5), max_size=60),
    n=st.integers(0, 7),
    min_points=st.integers(1, 6),
    data=st.data(),
)
def test_selection_equals_counting(labels: list[int], n: int, min_points: int, data: st.DataObject) -> None:
    valid = data.draw(st.lists(st.booleans(), min_size=len(labels), max_size=len(labels)))
    sizes = Counter(label for label, present in zip(labels, valid, strict=True) if present and label >= 0)
    largest = sorted(sizes, key=lambda label: (-sizes[label], label))[:n]
    selected = {label for label in largest if sizes[label] >= min_points}
    expected = [present and label in selected for label, present in zip(labels, valid, strict=True)]
    row = torch.tensor([labels], dtype=torch.int64), torch.tensor([valid], dtype=torch.bool)
    assert largest_clusters(*row, n, min_points)[0].tolist() == expected


def test_convention_ties_go_to_the_lowest_label() -> None:
    labels = torch.tensor([[1, 1, 0, 0, 2, -1]])
    selected = largest_clusters(labels, torch.ones(1, 6, dtype=torch.bool))
    assert selected.tolist() == [[False, False, True, True, False, False]]


def test_number_of_clusters_per_cloud_ignores_padding() -> None:
    labels = torch.tensor([[0, 0, 0, 1, 1, 2], [3, 3, 0, 3, -1, -1], [-1, -1, -1, -1, -1, -1]])
    valid = torch.tensor([[True] * 6, [True] * 3 + [False] * 3, [True] * 6])
    selected = largest_clusters(labels, valid, torch.tensor([2, 1, 3]))
    assert selected.tolist() == [[True] * 5 + [False], [True, True] + [False] * 4, [False] * 6]


def test_empty_clouds_have_no_clusters() -> None:
    for shape in [(0, 3), (2, 0)]:
        selected = largest_clusters(torch.zeros(shape, dtype=torch.int64), torch.zeros(shape, dtype=torch.bool))
        assert selected.shape == shape and selected.dtype == torch.bool


@pytest.mark.parametrize("dtype", [torch.int32, torch.float32])
def test_labels_of_another_type_are_rejected(dtype: torch.dtype) -> None:
    labels, valid = torch.zeros(1, 3, dtype=dtype), torch.ones(1, 3, dtype=torch.bool)
    with pytest.raises(InputError, match=rf"^labels has the type {dtype}; give labels of type torch\.int64$"):
        largest_clusters(labels, valid)
