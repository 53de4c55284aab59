"""Kernel of DBSCAN; see `v3d_torch.objects.dbscan`.

The points are grouped by cells of a grid whose diagonal is the radius (Gunawan, Eindhoven University of Technology
2013): all points of a cell are neighbours, so that its core points belong to one cluster. Most distances are not
computed: a cell with enough points has only core points, and two cells are compared until one pair connects them.
Cells are numbered along y, then x, then z: what a camera sees is extended along y and thin along z, so that the cells
near a cell lie in a few long runs.
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

_STEPS = ((0, 0), (0, 1), (1, 0), (1, -1), (1, 1), (0, 2), (2, 0), (1, -2), (1, 2), (2, -1), (2, 1), (2, -2), (2, 2))
"""Steps along z and x to the cells with which a cell is compared, nearest first: the nearest decide most cases."""


@device
def _is_near(points: Floats, i: int, j: int, squared_radius: float) -> bool:
    x, y, z = points[0, i] - points[0, j], points[1, i] - points[1, j], points[2, i] - points[2, j]
    return x * x + y * y + z * z <= squared_radius


@device
def _root(parents: Ints, cell: int) -> int:
    while parents[cell] != cell:
        parents[cell] = parents[parents[cell]]
        cell = parents[cell]
    return cell


@device
def _neighbouring_cells(keys: Ints, side_x: int, side_y: int) -> tuple[Ints, Ints]:
    """Runs of occupied cells at most two cells apart from a cell along each axis: the cell, first and end of its run.

    Each pair of cells is in one run only. A run lies along y, and its points follow each other.

    Returns:
        Runs, step by step, (K, 3), and the end of each step, (13,).
    """
    runs, ends, count = np.empty((len(_STEPS) * len(keys), 3), np.int64), np.empty(len(_STEPS), np.int64), 0
    for step, (z, x) in enumerate(_STEPS):
        shift, first, end = (z * side_x + x) * side_y, 0, 0
        for cell in range(len(keys)):
            while first < len(keys) and keys[first] < keys[cell] + shift - 2:
                first += 1
            while end < len(keys) and keys[end] <= keys[cell] + shift + 2:
                end += 1
            runs[count, 0], runs[count, 1], runs[count, 2] = cell, max(first, cell + 1), end
            count += runs[count, 1] < end  # without a branch; an empty run is overwritten
        ends[step] = count
    return runs[:count], ends


@device
def _find_core_points(
    points: Floats, begins: Ints, runs: Ints, ends: Ints, squared_radius: float, min_samples: int
) -> Bools:
    """Mask of the core points, shape (N,). Neighbours are not counted where all points are known to be core points."""
    sizes, count, k = begins[1:] - begins[:-1], points.shape[1], 0
    neighbours, undecided = np.repeat(sizes, sizes), np.zeros(count + 1, np.int64)
    for end_of_step in ends:
        for i in range(count):
            undecided[i + 1] = undecided[i] + (neighbours[i] < min_samples)
        while k < end_of_step:
            cell, first, end = runs[k]
            low, high, begin, stop = begins[first], begins[end], begins[cell], begins[cell + 1]
            k += 1
            if undecided[high] - undecided[low] + undecided[stop] - undecided[begin] == 0:
                continue
            for i in range(begin, stop):
                near = 0
                for j in range(low, high):
                    is_near = _is_near(points, i, j, squared_radius)
                    neighbours[j] += is_near
                    near += is_near
                neighbours[i] += near
    return neighbours >= min_samples


@device
def _has_core_neighbours(points: Floats, begins: Ints, a: int, b: int, squared_radius: float, core: Bools) -> bool:
    """Check whether a core point of one cell is a neighbour of a core point of another."""
    for i in range(begins[a], begins[a + 1]):
        if core[i]:
            for j in range(begins[b], begins[b + 1]):
                if core[j] and _is_near(points, i, j, squared_radius):
                    return True
    return False


@device
def _join_cells(points: Floats, begins: Ints, runs: Ints, squared_radius: float, core: Bools) -> Ints:
    """Parent of each cell, shape (C,), in a forest with one tree for each cluster."""
    parents = np.arange(len(begins) - 1)
    for a, first, end in runs:
        root = _root(parents, a)
        for b in range(first, end):
            other = _root(parents, b)
            if other != root and _has_core_neighbours(points, begins, a, b, squared_radius, core):
                parents[other] = root
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
    keys = (indices[:, 2] * sides[0] + indices[:, 0]) * sides[1] + indices[:, 1]
    order = argsort(keys, keys.max())
    points, keys = np.ascontiguousarray(points[order].T), keys[order]
    begins, cells, position, cell = np.empty(count + 1, np.int64), np.empty(count, np.int64), np.empty_like(order), -1
    for k in range(count):
        if k == 0 or keys[k] != keys[k - 1]:
            cell += 1
            begins[cell] = k
        cells[k], position[order[k]] = cell, k
    begins[cell + 1] = count
    begins = begins[: cell + 2]

    runs, ends = _neighbouring_cells(keys[begins[:-1]], sides[0], sides[1])
    core = _find_core_points(points, begins, runs, ends, squared, min_samples)
    parents = _join_cells(points, begins, runs, squared, core)
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
    for a, first, end in runs:
        for b in range(first, end):
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
