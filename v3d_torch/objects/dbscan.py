"""DBSCAN on padded batches of point clouds (paper, Sec. III-B.2; Ester et al., KDD 1996)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.argument_checks import (
    check_counts,
    check_masks,
    check_not_jit_traced,
    check_shape,
    is_count,
)
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import dbscan as kernels
from v3d_torch.kernels.compiler import can_read, compiled_by, to_array

_MAX_PAIRS = 2**25
"""Maximum number of neighbour pairs that are listed at once; it bounds the memory."""

_BLOCK = 2**20
"""Number of neighbours in one block, if a cloud has more than `_MAX_PAIRS` pairs."""

_MAX_NEIGHBOUR_CELLS = 13.5
"""Upper bound on the number of pairs, divided by the sum of the squared numbers of points in the cells: the neighbours
of a point can lie in 27 cells, and every pair counts once."""

_HASH_PRIMES = (73856093, 19349663, 83492791)
"""Spatial hash of a cell (Teschner et al., VMV 2003)."""

_HASH_MASK = 0xFFFF
"""Bit mask of the hash: size of the hash table minus one."""

Ints = NDArray[np.signedinteger]
Pairs = tuple[Ints, Ints]


def _dbscan_compiled(points: Tensor, valid: Tensor, eps: float, min_samples: int) -> Tensor:
    if points.ndim != 3 or points.shape[2] != 3 or points.shape[:2] != valid.shape:
        return NotImplemented
    if not eps > 0 or not is_count(min_samples) or min_samples < 1:
        return NotImplemented
    if points.dtype not in (torch.float32, torch.float64) or valid.dtype != torch.bool:
        return NotImplemented
    mask, coordinates = valid.numpy(), to_array(points)
    labels = np.full(mask.shape, -1)
    for cloud, present, found in zip(coordinates, mask, labels, strict=True):
        selected = cloud[present].astype(np.float64)
        if not np.isfinite(selected).all():
            return NotImplemented
        if len(selected) and np.ptp(selected, axis=0).max() > kernels.MAX_CELLS * eps / 2:
            return NotImplemented
        found[present] = kernels.dbscan(selected, eps, min_samples)
    return torch.from_numpy(labels)


@compiled_by(_dbscan_compiled)
def dbscan(points: Tensor, valid: Tensor, eps: float, min_samples: int) -> Tensor:
    r"""Label the density-connected clusters of every cloud of a batch.

    A point with at least ``min_samples`` points within ``eps`` (itself and the boundary included) is a core point; core
    points within ``eps`` of each other belong to the same cluster. Clusters are numbered by their first core point. A
    border point belongs to the cluster with the lowest number that has a core point within ``eps``. The labels are
    exactly those of scikit-learn.

    Args:
        points: Point clouds, metres, floating point, shape :math:`(B, N, 3)`.
        valid: Mask of the points that are not padding, bool, shape :math:`(B, N)`; the values of padding are ignored.
        eps: Radius of a neighbourhood, metres.
        min_samples: Minimum number of points in the neighbourhood of a core point, itself included.

    Returns:
        Cluster of each point, from 0 in every cloud; -1 for noise and for points that are not valid; int64, shape
        :math:`(B, N)`. Distances are compared in float64. On the CPU, memory grows with the number of neighbours, not
        with :math:`N^2`, and is bounded. On other devices, and if torch traces the computation, memory grows with
        :math:`N^2` and time with :math:`N^3 \log N`.

    Raises:
        ConfigError: If ``eps`` or ``min_samples`` is not positive, or ``min_samples`` is not a whole number.
        InputError: If a valid point is not finite, if ``valid`` is not bool, or in `torch.jit.trace`.
    """
    check_not_jit_traced("dbscan")
    check_masks(valid=valid)
    check_shape("points", points, "B", "N", 3)
    check_shape("valid", valid, *points.shape[:2])
    _check_settings(eps, min_samples)
    if not can_read(points):
        return _cluster_densely(points.detach(), valid, eps, min_samples)
    mask = valid.numpy()
    index = np.flatnonzero(mask)
    coordinates = points.detach().to(torch.float64).numpy().reshape(-1, 3).take(index, axis=0)
    if not np.isfinite(coordinates).all():
        raise InputError("dbscan: a valid point is not finite; mark points without depth as invalid")
    clouds = np.split(coordinates, mask.sum(axis=1).cumsum()[:-1])
    labels = np.full(mask.size, -1)
    labels[index] = np.concatenate([_cluster(cloud, eps, min_samples) for cloud in clouds])
    return torch.from_numpy(labels.reshape(mask.shape))


def _check_settings(eps: float, min_samples: int) -> None:
    if not eps > 0 or min_samples < 1:  # also if eps is NaN
        raise ConfigError(
            f"dbscan: eps is {eps} and min_samples is {min_samples}; give eps above 0 and min_samples of at least 1"
        )
    check_counts(min_samples=min_samples)


def _cluster_densely(points: Tensor, valid: Tensor, eps: float, min_samples: int) -> Tensor:
    """Labels of a batch of clouds, (B, N), from matrices of all pairs of points; no value is read on the host."""
    axes = torch.where(valid[..., None], points.to(torch.float64), 0.0).unbind(dim=-1)
    squared = sum((axis[..., :, None] - axis[..., None, :]).square() for axis in axes)
    near = (squared <= eps**2) & valid[..., :, None] & valid[..., None, :]
    core = near.sum(dim=-1) >= min_samples
    # Squaring the matrix of connections doubles the number of steps between two points that it connects.
    connected, size = near & core[..., :, None] & core[..., None, :], valid.shape[1]
    for _ in range((size - 1).bit_length() if size else 0):
        paths = connected.to(torch.float32)
        connected = paths @ paths > 0
    index = torch.arange(size, device=points.device)
    if size == 0:
        return index.expand(valid.shape)
    first = torch.where(connected, index, size).amin(dim=-1)  # lowest core point of the cluster of each core point
    number = (first == index).cumsum(dim=-1) - 1
    label = number.gather(-1, first.clamp(max=size - 1))
    # A border point gets the lowest label of the core points near it.
    lowest = torch.where(near & core[..., None, :], label[..., None, :], size).amin(dim=-1)
    return torch.where(lowest < size, lowest, -1)


def _cluster(points: NDArray[np.float64], eps: float, min_samples: int) -> Ints:
    """Return the labels of one cloud, shape (N,)."""
    size = len(points)
    counts, blocks = _neighbours(points, eps)
    core = counts >= min_samples

    # Connect core points. Components are read for every pair, and int32 halves the memory traffic.
    component = np.arange(size, dtype=np.int32)
    borders: list[Pairs] = []  # (border point, core point that reaches it)
    for a, b in blocks:
        a_core, b_core = core[a], core[b]
        both_core = a_core & b_core
        component = _join(component, component[a[both_core]], component[b[both_core]])
        for one_core, border, other in ((a_core > b_core, b, a), (b_core > a_core, a, b)):
            borders.append((border[one_core], other[one_core]))

    # Number the components by their lowest core point: with repeated indices, the last assignment is kept.
    cores = np.flatnonzero(core)[::-1]
    first = np.full(size, size)
    first[component[cores]] = cores
    rank = np.empty(size, dtype=np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(size)

    label = np.where(core, rank[component], size)
    for border, core_point in borders:
        np.minimum.at(label, border, label[core_point])
    return np.where(label < size, label, -1)


def _neighbours(points: NDArray[np.float64], eps: float) -> tuple[Ints, Iterable[Pairs]]:
    """Return the neighbour count of each point, itself included, and every pair of neighbours once, in blocks."""
    tree = scipy.spatial.cKDTree(points, balanced_tree=False, leafsize=32)
    if _max_pairs(points, eps) <= _MAX_PAIRS:
        pairs = tree.query_pairs(eps, output_type="ndarray")
        a, b = pairs.T.astype(np.int32)  # contiguous and small, because they are read many times
        return np.bincount(pairs.ravel(), minlength=len(points)) + 1, [(a, b)]
    counts = tree.query_ball_point(points, eps, return_length=True)
    return counts, _pairs_in_blocks(tree, counts, eps)


def _max_pairs(points: NDArray[np.float64], eps: float) -> float:
    """Return an upper bound on the number of neighbour pairs.

    Neighbours lie in the same or in adjacent cells of side ``eps``. The bound is a multiple of the sum of squared
    numbers of points in the cells. Hash collisions of cells can only increase it.
    """
    one_cell = _MAX_NEIGHBOUR_CELLS * len(points) ** 2
    if one_cell <= _MAX_PAIRS:
        return one_cell
    cells = np.floor(points / eps).astype(np.int64) * _HASH_PRIMES
    occupancy = np.bincount(np.bitwise_xor.reduce(cells, axis=1) & _HASH_MASK)
    return _MAX_NEIGHBOUR_CELLS * float(np.dot(occupancy, occupancy))


def _pairs_in_blocks(tree: scipy.spatial.cKDTree, counts: Ints, eps: float) -> Iterator[Pairs]:
    """Yield every pair once, in blocks of bounded size; each block contains the neighbours of some adjacent points."""
    order = tree.indices
    block = np.cumsum(counts[order]) // _BLOCK
    for points in np.split(order, np.flatnonzero(np.diff(block)) + 1):
        neighbours = scipy.spatial.cKDTree(tree.data[points]).sparse_distance_matrix(tree, eps, output_type="ndarray")
        a, b = points[neighbours["i"]], neighbours["j"]
        once = a < b
        yield a[once], b[once]


def _join(component: Ints, a: Ints, b: Ints) -> Ints:
    """Return the components, numbered below N, after connecting components ``a[k]`` and ``b[k]`` for every k.

    Most pairs are redundant. Each round links every component to one partner with a lower number and follows the links
    to their roots, which merges nearly all connected components at once. The few pairs that still connect two
    components enter the next round.
    """
    while len(a):
        parent = np.arange(len(component), dtype=component.dtype)
        parent[np.maximum(a, b)] = np.minimum(a, b)
        while not np.array_equal(parent, grandparent := parent[parent]):
            parent = grandparent
        component, a, b = parent[component], parent[a], parent[b]
        separate = a != b
        a, b = a[separate], b[separate]
    return component


class DBSCAN(SettingsModule):
    """:func:`dbscan` as a module.

    Args:
        eps: Radius of a neighbourhood, metres.
        min_samples: Minimum number of points in the neighbourhood of a core point, itself included.

    Raises:
        ConfigError: If a number is not possible; see :func:`dbscan`.
    """

    def __init__(self, eps: float, min_samples: int) -> None:
        _check_settings(eps, min_samples)
        super().__init__()
        self.eps = eps
        self.min_samples = min_samples

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """Label clouds, metres, shape :math:`(B, N, 3)`, with mask :math:`(B, N)`; see :func:`dbscan`."""
        return dbscan(points, valid, self.eps, self.min_samples)
