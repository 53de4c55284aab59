"""Keys of cells: round trip, order, distinct at the bounds."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.geometry.cell_keys import MAX_COORDINATE, cell_keys, cells_of_keys

coordinates = st.one_of(
    st.integers(-3, 3), st.integers(-MAX_COORDINATE, MAX_COORDINATE - 1), st.sampled_from([-MAX_COORDINATE, 0, -1])
)


@given(cells=st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=20))
def test_keys_are_distinct_ordered_and_give_the_cells_back(cells: list[tuple[int, int, int]]) -> None:
    keys = cell_keys(torch.tensor(cells))
    assert cells_of_keys(keys).tolist() == [list(cell) for cell in cells]
    assert keys.argsort(stable=True).tolist() == sorted(range(len(cells)), key=lambda index: cells[index])
    assert len(keys.unique()) == len(set(cells))
