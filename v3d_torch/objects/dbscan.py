"""DBSCAN on padded batches of point clouds (paper, Sec. III-B.2; Ester et al., KDD 1996)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError

_MAX_PAIRS = 2**25
"""Most neighbour pairs, by an upper bound, that are listed at once: at the bound a surface takes about 0.2 GB."""

_BLOCK = 2**20
"""Neighbours listed at a time in a cloud with more pairs than that."""

Ints = NDArray[np.signedinteger]
Pairs = tuple[Ints, Ints]


def dbscan(points: Tensor, valid: Tensor, eps: float, min_samples: int) -> Tensor:
    """Label the density-connected clusters of every cloud of a batch.

    A point with at least ``min_samples`` points within ``eps`` (itself and the boundary included) is a core point; core
    points within ``eps`` of each other share a cluster. Clusters are numbered by their first core point, and a border
    point joins the lowest-numbered cluster that reaches it: the labels are those of scikit-learn, number by number.

    Args:
        points: metres, float32 or float64, shape :math:`(B, N, 3)`.
        valid: which points exist, bool, shape :math:`(B, N)`; what stands in the others is not looked at.
        eps: radius of a neighbourhood, metres.
        min_samples: points in a neighbourhood that make its centre a core point.

    Returns:
        Cluster of each point, from 0 in every cloud; -1 for noise and for points that are not valid; int64, shape
        :math:`(B, N)`. Distances are compared in float64. Memory grows with the number of neighbours, not with
        :math:`N^2`, and is bounded where they are many.

    Raises:
        ConfigError: if ``eps`` or ``min_samples`` is not positive.
        InputError: if a valid point is not finite.
    """
    KORNIA_CHECK_SHAPE(points, ["B", "N", "3"])
    KORNIA_CHECK_SHAPE(valid, [str(size) for size in points.shape[:2]])
    if eps <= 0 or min_samples < 1:
        raise ConfigError(f"DBSCAN needs eps > 0 and min_samples >= 1, not {eps} and {min_samples}.")
    mask = valid.numpy()
    index = np.flatnonzero(mask)
    coordinates = points.detach().numpy().reshape(-1, 3).take(index, axis=0).astype(np.float64)
    if not np.isfinite(coordinates).all():
        raise InputError("A point to be clustered is not finite; mark points without depth as not valid.")
    clouds = np.split(coordinates, mask.sum(axis=1).cumsum()[:-1])
    labels = np.full(mask.size, -1)
    labels[index] = np.concatenate([_cluster(cloud, eps, min_samples) for cloud in clouds])
    return torch.from_numpy(labels.reshape(mask.shape))


def _cluster(points: NDArray[np.float64], eps: float, min_samples: int) -> Ints:
    """Labels of one cloud, shape (N,)."""
    size = len(points)
    counts, blocks = _neighbours(points, eps)
    core = counts >= min_samples

    component = np.arange(size, dtype=np.int32)  # it is read for every pair: half the size, as they are
    borders: list[Pairs] = []  # (border point, core point that reaches it)
    for a, b in blocks:
        a_core, b_core = core[a], core[b]
        inner = a_core & b_core
        component = _join(component, component[a[inner]], component[b[inner]])
        for outer, point, other in ((a_core > b_core, b, a), (b_core > a_core, a, b)):
            borders.append((point[outer], other[outer]))

    cores = np.flatnonzero(core)[::-1]
    first = np.full(size, size)
    first[component[cores]] = cores  # of repeated indices the last is kept: the lowest core point of each component
    rank = np.empty(size, dtype=np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(size)

    label = np.where(core, rank[component], size)
    for border, reached_from in borders:
        np.minimum.at(label, border, label[reached_from])
    return np.where(label < size, label, -1)


def _neighbours(points: NDArray[np.float64], eps: float) -> tuple[Ints, Iterable[Pairs]]:
    """Number of points within ``eps`` of each point, itself included, and every pair of neighbours once, in blocks."""
    tree = cKDTree(points, balanced_tree=False, leafsize=32)
    if _most_pairs(points, eps) <= _MAX_PAIRS:
        pairs = tree.query_pairs(eps, output_type="ndarray")
        a, b = pairs.T.astype(np.int32)  # contiguous and half the size: they are read many times from here on
        return np.bincount(pairs.ravel(), minlength=len(points)) + 1, [(a, b)]
    counts = tree.query_ball_point(points, eps, return_length=True)
    return counts, _pairs_in_blocks(tree, counts, eps)


def _most_pairs(points: NDArray[np.float64], eps: float) -> float:
    """Upper bound on the number of neighbour pairs.

    Neighbours are in the same or in touching cells of side ``eps``, hence at most 27/2 times the sum of squared cell
    counts. Cells that share a place of the hash table only raise the bound.
    """
    in_one_cell = 13.5 * len(points) ** 2
    if in_one_cell <= _MAX_PAIRS:  # wherever so few points are
        return in_one_cell
    cells = np.floor(points / eps).astype(np.int64) * (73856093, 19349663, 83492791)
    occupancy = np.bincount(np.bitwise_xor.reduce(cells, axis=1) & 0xFFFF)
    return 13.5 * float(np.dot(occupancy, occupancy))


def _pairs_in_blocks(tree: cKDTree, counts: Ints, eps: float) -> Iterator[Pairs]:
    """Every pair once, in blocks of bounded size: neighbours of some points that lie together in space."""
    order = tree.indices
    block = np.cumsum(counts[order]) // _BLOCK
    for points in np.split(order, np.flatnonzero(np.diff(block)) + 1):
        found = cKDTree(tree.data[points]).sparse_distance_matrix(tree, eps, output_type="ndarray")
        a, b = points[found["i"]], found["j"]
        once = a < b
        yield a[once], b[once]


def _join(component: Ints, a: Ints, b: Ints) -> Ints:
    """Components, numbered below N, after connecting components ``a[k]`` and ``b[k]`` for every k.

    Most pairs tell nothing new. If every component follows one partner of lower number, and that one its own to the
    end, nearly all that belongs together has met; the pairs that still connect two components after that are few, and
    are taken in the same way, until there are none.
    """
    while len(a):
        follows = np.arange(len(component), dtype=component.dtype)
        follows[np.maximum(a, b)] = np.minimum(a, b)
        while not np.array_equal(follows, further := follows[follows]):
            follows = further
        component, a, b = follows[component], follows[a], follows[b]
        apart = a != b
        a, b = a[apart], b[apart]
    return component


class DBSCAN(torch.nn.Module):
    """:func:`dbscan` as a module.

    Args:
        eps: radius of a neighbourhood, metres.
        min_samples: points in a neighbourhood, its centre included, that make the centre a core point.
    """

    def __init__(self, eps: float, min_samples: int) -> None:
        super().__init__()
        self.eps = eps
        self.min_samples = min_samples

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Label clouds, metres, shape :math:`(B, N, 3)` with mask :math:`(B, N)`; see :func:`dbscan`."""
        return dbscan(points, valid, self.eps, self.min_samples)
