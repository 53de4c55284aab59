"""Selection of corners by quadtrees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from v3d_torch.features.corner_selection import select_corners
from v3d_torch.kernels.compiler import ENABLED, TWINS

Ints = NDArray[np.int64]
SIZES = [(640, 480), (320, 240), (90, 300), (1300, 100)]
TWIN = TWINS["v3d_torch.features.corner_selection._select_strongest"]


def random_corners(count: int, seed: int, clusters: int = 5) -> tuple[Ints, Ints, Ints]:
    """Corners in clusters, without two at one pixel, with few different responses; sorted by image."""
    generator = np.random.default_rng(seed)
    image = generator.integers(0, len(SIZES), count)
    sizes = np.array(SIZES)[image]
    centre = generator.random((clusters, 2))[generator.integers(0, clusters, count)]
    position = np.clip(centre + 0.1 * generator.standard_normal((count, 2)), 0, 0.999)
    corners = np.unique(np.concatenate([image[:, None], (position * sizes).astype(np.int64)], axis=1), axis=0)
    return np.ascontiguousarray(corners[:, 1:]), generator.integers(20, 30, len(corners)), corners[:, 0].copy()


@pytest.mark.parametrize("count", [0, 1, 30, 3000])
@pytest.mark.parametrize("wanted", [1, 5, 60, 10_000])
def test_as_many_corners_are_selected_as_wanted(count: int, wanted: int) -> None:
    corners, response, image = random_corners(count, seed=count)
    selected = select_corners(corners, response, image, SIZES, [wanted] * len(SIZES))
    assert len(np.unique(selected)) == len(selected)
    assert (np.diff(image[selected]) >= 0).all()
    for index, size in enumerate(SIZES):
        squares = round(size[0] / size[1])  # at least one corner of each square cell of the first level
        found, given_ = (image[selected] == index).sum(), (image == index).sum()
        if given_ <= wanted:
            assert found == given_
        else:
            assert wanted <= found <= max(wanted + 3, squares, 4)


@given(st.integers(0, 400), st.integers(0, 1000), st.lists(st.integers(1, 200), min_size=4, max_size=4))
@pytest.mark.skipif(not ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")
def test_kernel_equals_its_twin(count: int, seed: int, wanted: list[int]) -> None:
    generator = np.random.default_rng(seed)
    code = (generator.integers(0, 4, count) << 24) | generator.integers(0, 1 << generator.integers(1, 24), count)
    arguments = code, generator.integers(20, 24, count), np.array(wanted)
    np.testing.assert_array_equal(TWIN.compiled(*arguments), TWIN.torch(*arguments))


def test_strongest_corner_of_each_quarter_is_selected() -> None:
    corners = np.array([[10, 10], [40, 20], [90, 10], [60, 30], [20, 80], [70, 70], [90, 90]])
    response = np.array([30, 50, 20, 60, 10, 40, 40])
    selected = select_corners(corners, response, np.zeros(7, np.int64), [(100, 100)], [4])
    assert sorted(selected.tolist()) == [1, 3, 4, 5]  # of equal corners the first


def test_fullest_cells_are_divided_first() -> None:
    corners = np.array([[10, 10], [40, 10], [10, 40], [90, 10], [60, 10], [10, 90], [90, 90]])
    selected = select_corners(corners, np.full(7, 20), np.zeros(7, np.int64), [(100, 100)], [6])
    assert sorted(selected.tolist()) == [0, 1, 2, 3, 5, 6]  # the cell with three corners, not that with two


def test_corners_are_spread_over_the_image() -> None:
    generator = np.random.default_rng(0)
    dense = generator.integers(0, 60, (2000, 2))
    sparse = np.stack(np.meshgrid(np.arange(80, 640, 40), np.arange(80, 480, 40)), axis=-1).reshape(-1, 2)
    corners = np.concatenate([dense, sparse])
    response = np.concatenate([np.full(len(dense), 200), np.full(len(sparse), 20)])
    selected = select_corners(corners, response, np.zeros(len(corners), np.int64), [(640, 480)], [300])
    assert np.isin(np.arange(len(dense), len(corners)), selected).mean() > 0.9
