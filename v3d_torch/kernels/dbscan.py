"""Kernel of DBSCAN; see `v3d_torch.objects.dbscan`.

The points are grouped by cells of a grid whose diagonal is the radius (Gunawan, Eindhoven University of Technology
2013): all points of a cell are neighbours, so that its core points belong to one cluster. Most distances are not
computed: a cell with enough points has only core points, and two cells are compared until one pair connects them.
"""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats, Ints
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.radix_sort import argsort

MAX_CELLS = 2.0**20
"""Upper bound of the bounding box along each axis, cells. Rounding errors are then far smaller than `_MARGIN`."""

_MARGIN = 1e-9
"""Relative difference between the diagonal of a cell and the radius, more than the rounding errors of cell indices."""


@device
def _is_near(points: Floats, i: int, j: int, squared_radius: float) -> bool:
    x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    return x * x + y * y + z * z <= squared_radius


@device
def _root(parents: Ints, cell: int) -> int:
    while parents[cell] != cell:
        parents[cell] = parents[parents[cell]]
        cell = parents[cell]
    return cell


@device
def _neighbouring_cells(keys: Ints, side_y: int, side_z: int) -> Ints:
    """Pairs of occupied cells at most two cells apart along each axis, shape (K, 2), the lower index first."""
    pairs, count = np.empty((16 * len(keys), 2), np.int64), 0
    for x in range(3):
        for y in range(-2 if x else 0, 3):
            shift, first = (x * side_y + y) * side_z, 0
            for cell in range(len(keys)):
                while first < len(keys) and keys[first] < keys[cell] + shift - 2:
                    first += 1
                other = max(first, cell + 1)
                while other < len(keys) and keys[other] <= keys[cell] + shift + 2:
                    if count == len(pairs):
                        pairs = np.concatenate((pairs, np.empty_like(pairs)))
                    pairs[count, 0], pairs[count, 1] = cell, other
                    count, other = count + 1, other + 1
    return pairs[:count]


@device
def _find_core_points(points: Floats, begins: Ints, pairs: Ints, squared_radius: float, min_samples: int) -> Bools:
    """Mask of the core points, shape (N,). Neighbours of a point are counted until it is known to be a core point."""
    sizes = begins[1:] - begins[:-1]
    neighbours = np.repeat(sizes, sizes)
    for a, b in pairs:
        if sizes[a] < min_samples or sizes[b] < min_samples:
            for i in range(begins[a], begins[a + 1]):
                for j in range(begins[b], begins[b + 1]):
                    is_open = neighbours[i] < min_samples or neighbours[j] < min_samples
                    if is_open and _is_near(points, i, j, squared_radius):
                        neighbours[i] += 1
                        neighbours[j] += 1
    return neighbours >= min_samples


@device
def _join_cells(points: Floats, begins: Ints, pairs: Ints, squared_radius: float, core: Bools) -> Ints:
    """Parent of each cell, shape (C,), in a forest with one tree for each cluster."""
    parents = np.arange(len(begins) - 1)
    for a, b in pairs:
        root, other, i = _root(parents, a), _root(parents, b), begins[a]
        while i < begins[a + 1] and root != other:
            j = begins[b]
            while core[i] and j < begins[b + 1] and root != other:
                if core[j] and _is_near(points, i, j, squared_radius):
                    parents[other] = root
                    other = root
                j += 1
            i += 1
    return parents


@kernel("(f8[:,::1], f8, i8)")
def dbscan(points: Floats, eps: float, min_samples: int) -> Ints:
    """Cluster of each point of one cloud, (N,); -1 for noise.

    Args:
        points: Points, metres, (N, 3); their bounding box has less than `MAX_CELLS` cells along each axis.
        eps: Radius of a neighbourhood, metres.
        min_samples: Minimum number of points in the neighbourhood of a core point, itself included.
    """
    count, side, squared = len(points), eps / math.sqrt(3) * (1 - _MARGIN), eps * eps
    labels = np.full(count, -1)
    if count == 0:
        return labels
    indices, sides = np.empty((count, 3), np.int64), np.empty(3, np.int64)
    for axis in range(3):
        low = points[:, axis].min()
        for i in range(count):
            indices[i, axis] = math.floor((points[i, axis] - low) / side)
        sides[axis] = indices[:, axis].max() + 3  # two empty cells, so that steps do not lead to the next row
    keys = (indices[:, 0] * sides[1] + indices[:, 1]) * sides[2] + indices[:, 2]
    order = argsort(keys, keys.max())
    points, keys = points[order], keys[order]
    begins, cells, position, cell = np.empty(count + 1, np.int64), np.empty(count, np.int64), np.empty_like(order), -1
    for k in range(count):
        if k == 0 or keys[k] != keys[k - 1]:
            cell += 1
            begins[cell] = k
        cells[k], position[order[k]] = cell, k
    begins[cell + 1] = count
    begins = begins[: cell + 2]

    pairs = _neighbouring_cells(keys[begins[:-1]], sides[1], sides[2])
    core = _find_core_points(points, begins, pairs, squared, min_samples)
    parents = _join_cells(points, begins, pairs, squared, core)
    clusters, next_cluster = np.full(len(parents), count), 0  # not numbered yet
    for k in position:  # clusters are numbered by their lowest core point
        if core[k]:
            root = _root(parents, cells[k])
            if clusters[root] == count:
                clusters[root] = next_cluster
                next_cluster += 1
            clusters[cells[k]] = clusters[root]
    found, has_border = clusters[cells], np.zeros(len(parents), np.bool_)
    for k in range(count):
        has_border[cells[k]] |= not core[k]
    for a, b in pairs:
        if not (has_border[a] or has_border[b]):
            continue
        for i in range(begins[a], begins[a + 1]):
            for j in range(begins[b], begins[b + 1]):
                if core[i] != core[j] and _is_near(points, i, j, squared):
                    border, cluster = (j, clusters[a]) if core[i] else (i, clusters[b])
                    found[border] = min(found[border], cluster)
    for k in range(count):
        if found[k] < count:
            labels[order[k]] = found[k]
    return labels
