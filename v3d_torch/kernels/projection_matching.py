"""Kernels of projection matching; see `v3d_torch.features.projection_search`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Floats, Ints, Words
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.descriptors import MAX_DISTANCE, hamming_distance


@device
def _sort_by_cell(column: Ints, row: Ints, width: int, height: int) -> tuple[Ints, Ints]:
    """Order of features by the cells of a grid, row by row, and the first position of each cell in this order."""
    begin = np.zeros(width * height + 1, np.int64)
    for i in range(len(column)):
        begin[row[i] * width + column[i] + 1] += 1
    begin = begin.cumsum()
    free, order = begin.copy(), np.empty(len(column), np.int64)
    for i in range(len(column)):
        cell = row[i] * width + column[i]
        order[free[cell]] = i
        free[cell] += 1
    return order, begin


@kernel("(f8[:,::1], f8[::1], i8[::1], u8[:,::1], f8[:,::1], i8[::1], u8[:,::1], i8, f8, f8)")
def match_by_projection(
    projected: Floats, radius: Floats, landmark_octave: Ints, landmark_descriptors: Words, uv: Floats, octave: Ints,
    descriptors: Words, max_hamming: int, max_ratio: float, cell: float,
) -> Ints:  # fmt: skip
    """Pairs (landmark, feature) with similar descriptors near the landmark's projection, sorted by landmark, (K, 2).

    Args:
        projected: Projection of each landmark, pixels, (L, 2).
        radius: Search radius around each projection, pixels, (L,).
        landmark_octave: Expected octave of each landmark, (L,).
        landmark_descriptors: Descriptors of the landmarks, (L, 4).
        uv: Pixels of the features, at least one, (N, 2).
        octave: Octaves of the features, (N,).
        descriptors: Descriptors of the features, (N, 4).
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: Maximum ratio of the best to the second-best distance.
        cell: Side of the cells of the search grid, pixels.
    """
    u0, v0 = uv[:, 0].min(), uv[:, 1].min()
    column, row = np.floor((uv[:, 0] - u0) / cell).astype(np.int64), np.floor((uv[:, 1] - v0) / cell).astype(np.int64)
    width, height = column.max() + 1, row.max() + 1
    order, begin = _sort_by_cell(column, row, width, height)

    distance_of, landmark_of = np.full(len(uv), MAX_DISTANCE), np.full(len(uv), -1)
    for k in range(len(projected)):
        u, v, r = projected[k, 0] - u0, projected[k, 1] - v0, radius[k]
        left, right = max(math.floor((u - r) / cell), 0), min(math.floor((u + r) / cell), width - 1)
        top, bottom = max(math.floor((v - r) / cell), 0), min(math.floor((v + r) / cell), height - 1)
        if left > right:
            continue
        best, second, nearest = MAX_DISTANCE, math.inf, -1
        for y in range(top, bottom + 1):
            for position in range(begin[y * width + left], begin[y * width + right + 1]):
                i = order[position]
                du, dv = uv[i, 0] - projected[k, 0], uv[i, 1] - projected[k, 1]
                if not du * du + dv * dv <= r * r or abs(landmark_octave[k] - octave[i]) > 1:
                    continue
                distance = hamming_distance(landmark_descriptors, k, descriptors, i)
                if distance < best:
                    if nearest >= 0:
                        second = best
                    best, nearest = distance, i
                elif distance < second:
                    second = distance
        if nearest < 0 or best > max_hamming or best > max_ratio * second:
            continue
        if best < distance_of[nearest]:  # the lower index wins ties
            distance_of[nearest], landmark_of[nearest] = best, k

    feature_of = np.full(len(projected), -1)
    for i in range(len(uv)):
        if landmark_of[i] >= 0:
            feature_of[landmark_of[i]] = i
    matched = np.flatnonzero(feature_of >= 0)
    return np.stack((matched, feature_of[matched]), axis=1)
