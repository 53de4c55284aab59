"""DBSCAN against scikit-learn, label by label."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import sklearn.cluster
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from scipy.spatial import cKDTree
from sklearn.neighbors import NearestNeighbors

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.objects import dbscan as module
from v3d_torch.objects.dbscan import DBSCAN, dbscan


def oracle(points: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """Return the labels of scikit-learn's KD-tree; its brute force for small clouds rounds distances."""
    if len(points) == 0:
        return np.zeros(0, dtype=int)
    return sklearn.cluster.DBSCAN(eps=eps, min_samples=min_samples, algorithm="kd_tree").fit(points).labels_


def labels_of(points: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """Return our labels of one cloud."""
    return dbscan(torch.from_numpy(points)[None], torch.ones(1, len(points), dtype=torch.bool), eps, min_samples)[
        0
    ].numpy()


@pytest.fixture(params=["at once", "in blocks"])
def listing(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """List neighbours at once, or in blocks so small that every cloud needs many."""
    if request.param == "in blocks":
        monkeypatch.setattr(module, "_MAX_PAIRS", 0)
        monkeypatch.setattr(module, "_BLOCK", 64)
    return str(request.param)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("min_samples", [1, 4, 12])
@pytest.mark.parametrize("count", [1, 30, 400, 1500])
def test_labels_equal_scikit_learn(listing: str, count: int, min_samples: int, dtype: type) -> None:
    points = np.random.default_rng(count).random((count, 3)).astype(dtype)
    eps = 0.6 * count ** (-1 / 3)  # about one neighbour per point: clusters, border points and noise
    labels = labels_of(points, eps, min_samples)
    np.testing.assert_array_equal(labels, oracle(points.astype(np.float64), eps, min_samples))


@settings(max_examples=80)
@given(
    cells=st.lists(st.tuples(*[st.integers(-12, 12)] * 3), max_size=250),
    copies=st.integers(1, 3),
    eps=st.sampled_from([0.25, 0.5, 0.8]),
    min_samples=st.integers(1, 7),
    line=st.booleans(),
)
def test_labels_of_random_small_clouds_equal_scikit_learn(
    cells: list[tuple[int, int, int]], copies: int, eps: float, min_samples: int, line: bool
) -> None:
    # Multiples of 1/4: duplicates, lines, and many distances that are exactly eps.
    points = np.array(cells * copies, dtype=np.float64).reshape(-1, 3) / 4
    if line:
        points[:, 1:] = 0
    np.testing.assert_array_equal(labels_of(points, eps, min_samples), oracle(points, eps, min_samples))


SHAPES = {"box": (1.0, 1.0, 1.0), "sheet": (1.0, 2.0, 0.01), "line": (1.0, 0.0, 0.0)}


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 20_000),
    shape=st.sampled_from(sorted(SHAPES)),
    lattice=st.booleans(),
    min_samples=st.integers(1, 12),
)
@example(seed=0, count=20_000, shape="sheet", lattice=True, min_samples=5)
@example(seed=8997179, count=2, shape="box", lattice=False, min_samples=1)
def test_labels_of_random_large_clouds_equal_scikit_learn(
    seed: int, count: int, shape: str, lattice: bool, min_samples: int
) -> None:
    generator = np.random.default_rng(seed)
    points = generator.random((count, 3)) * SHAPES[shape]
    # With this radius about every second point is a core point: clusters, border points and noise.
    nearest = NearestNeighbors(n_neighbors=min(count, min_samples + 1)).fit(points).kneighbors(points)[0]
    eps = float(nearest[:, -1].mean()) * (1 + 1e-9) or 1.0  # two points would be eps apart, up to rounding errors
    if lattice:  # spacing eps / 2, exact: many points coincide, and many are exactly eps apart
        eps = 2.0 ** np.round(np.log2(eps))
        points = np.round(points * 2 / eps) * eps / 2
    np.testing.assert_array_equal(labels_of(points, eps, min_samples), oracle(points, eps, min_samples))


def test_convention_eps_and_the_point_itself_count() -> None:
    points = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]])
    assert labels_of(points, 0.5, 3).tolist() == [0, 0, 0]
    assert labels_of(points, 0.5, 4).tolist() == [-1, -1, -1]
    assert labels_of(points, 0.4999, 1).tolist() == [0, 1, 2]


@pytest.mark.parametrize("reverse", [False, True])
def test_border_point_joins_the_first_cluster_within_eps(listing: str, reverse: bool) -> None:
    # Two squares and a point between them at distance 1 from a corner of each: 3 points in its neighbourhood, no core.
    square = np.array([[1.0, 0, 0], [1.5, 0.5, 0], [1.5, -0.5, 0], [2.0, 0, 0]])
    points = np.concatenate([square * [-1, 1, 1], np.zeros((1, 3)), square])
    points = points[::-1].copy() if reverse else points
    labels = labels_of(points, 1.0, 4)
    assert labels.tolist() == [0] * 5 + [1] * 4
    np.testing.assert_array_equal(labels, oracle(points, 1.0, 4))


def test_memory_of_twenty_thousand_points_is_bounded(listing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if listing == "in blocks":
        monkeypatch.setattr(module, "_BLOCK", 2**16)
    points = np.random.default_rng(5).random((20_000, 3)) * [1.0, 2.0, 0.02]
    tracemalloc.start()
    labels = labels_of(points, 0.012, 5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(labels, oracle(points, 0.012, 5))
    assert peak < 60e6  # one bit for each of 20,000 x 20,000 pairs: 50 MB, a float32: 1.6 GB


def test_memory_is_bounded_if_all_points_are_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MAX_PAIRS", 2**20)
    monkeypatch.setattr(module, "_BLOCK", 2**16)
    points = np.random.default_rng(6).normal(0, 0.01, (2000, 3))
    tracemalloc.start()
    labels = labels_of(points, 0.2, 5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert not labels.any()
    assert peak < 10e6  # two million pairs of two int64: 32 MB


def test_blocks_contain_every_pair_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks are as large as allowed: both neighbours of a pair count, and each point itself."""
    monkeypatch.setattr(module, "_BLOCK", 64)
    points = np.random.default_rng(0).random((300, 3))
    tree = cKDTree(points)
    counts = tree.query_ball_point(points, 0.2, return_length=True)
    blocks = list(module._pairs_in_blocks(tree, counts, 0.2))
    pairs = [(i, j) for a, b in blocks for i, j in zip(a.tolist(), b.tolist(), strict=True)]
    assert len(pairs) == len(set(pairs)) and set(pairs) == tree.query_pairs(0.2)
    assert len(blocks) == len(np.unique(np.cumsum(counts[tree.indices]) // 64))


def test_clouds_of_a_batch_are_independent() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(4, 300, 3, generator=generator, dtype=torch.float64)
    valid = torch.rand(4, 300, generator=generator) < 0.8
    valid[2] = False
    points[~valid] = torch.nan
    labels = DBSCAN(eps=0.12, min_samples=4)(points, valid)
    assert labels.dtype == torch.int64
    assert (labels[~valid] == -1).all()
    for b in (0, 1, 3):
        np.testing.assert_array_equal(labels[b][valid[b]].numpy(), oracle(points[b][valid[b]].numpy(), 0.12, 4))


def test_permutation_keeps_clusters_of_core_points() -> None:
    points = np.random.default_rng(8).random((500, 3))
    shuffled = np.random.default_rng(9).permutation(500)
    labels, moved = labels_of(points, 0.1, 4)[shuffled], labels_of(points[shuffled], 0.1, 4)
    np.testing.assert_array_equal(labels == -1, moved == -1)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    core = ((distances <= 0.1).sum(axis=1) >= 4)[shuffled]
    assert len(set(zip(labels[core], moved[core], strict=True))) == len(set(labels[core]))


@pytest.mark.parametrize(("batch", "count"), [(0, 4), (3, 0), (3, 4)])
def test_empty_clouds_have_no_labels(batch: int, count: int) -> None:
    labels = dbscan(torch.zeros(batch, count, 3), torch.zeros(batch, count, dtype=torch.bool), 0.1, 3)
    assert labels.shape == (batch, count) and (labels == -1).all()


def test_invalid_settings_and_non_finite_points_are_rejected() -> None:
    points, valid = torch.zeros(1, 2, 3), torch.ones(1, 2, dtype=torch.bool)
    for eps, min_samples in [(0.0, 3), (float("nan"), 3), (0.1, 0)]:
        with pytest.raises(ConfigError, match="give eps above 0 and min_samples of at least 1"):
            dbscan(points, valid, eps, min_samples)
    points[0, 1, 2] = torch.nan
    message = r"^dbscan: a valid point is not finite; mark points without depth as invalid$"
    with pytest.raises(InputError, match=message):
        dbscan(points, valid, 0.1, 3)
    valid[0, 1] = False  # its values are ignored
    assert dbscan(points, valid, 0.1, 1).tolist() == [[0, -1]]


@pytest.mark.parametrize(("points", "valid"), [((2, 3), (2, 3)), ((1, 2, 2), (1, 2)), ((1, 2, 3), (1, 3)), ((3,), ())])
def test_wrong_shapes_are_rejected(points: tuple[int, ...], valid: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError):
        dbscan(torch.zeros(points), torch.ones(valid, dtype=torch.bool), 0.1, 3)
