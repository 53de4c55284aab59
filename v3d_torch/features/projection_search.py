"""Matching of landmarks to the features near their projections."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.features.matching import are_descriptors, as_words, hamming_distance
from v3d_torch.kernels import projection_matching as projection_kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

CELL = 8.0
"""Side of the cells of the search grid, pixels: about half a search radius, so that few pixels are candidates."""

_MAX_DISTANCE = 1 << 9
"""Factor that combines a landmark and a distance into one sort key; larger than any Hamming distance, bits."""


def _match_by_projection_compiled(
    projected: Tensor,
    radius: Tensor,
    landmark_octave: Tensor,
    landmark_descriptors: Tensor,
    uv: Tensor,
    octave: Tensor,
    descriptors: Tensor,
    *,
    max_hamming: int,
    max_ratio: float,
) -> Tensor:
    types = {projected.dtype, radius.dtype, uv.dtype}, {landmark_octave.dtype, octave.dtype}
    if types != ({torch.float64}, {torch.int64}) or not are_descriptors(landmark_descriptors, descriptors):
        return NotImplemented
    if uv.shape[0] == 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    pairs = projection_kernels.match_by_projection(
        to_array(projected),
        to_array(radius),
        to_array(landmark_octave),
        as_words(landmark_descriptors),
        to_array(uv),
        to_array(octave),
        as_words(descriptors),
        max_hamming,
        max_ratio,
        CELL,
    )
    return torch.from_numpy(pairs)


@compiled_by(_match_by_projection_compiled)
def match_by_projection(
    projected: Tensor,
    radius: Tensor,
    landmark_octave: Tensor,
    landmark_descriptors: Tensor,
    uv: Tensor,
    octave: Tensor,
    descriptors: Tensor,
    *,
    max_hamming: int,
    max_ratio: float,
) -> Tensor:
    """Match landmarks to the features near their projections (Mur-Artal and Tardos, ORB-SLAM2, Sec. III).

    Args:
        projected: Projection of each landmark, pixels, shape :math:`(L, 2)`.
        radius: Search radius around each projection, pixels, shape :math:`(L,)`.
        landmark_octave: Expected octave of each landmark, int64, shape :math:`(L,)`; a feature's can differ by one.
        landmark_descriptors: Descriptors of the landmarks, uint8, shape :math:`(L, 32)`.
        uv: Pixels of the features, shape :math:`(N, 2)`.
        octave: Octaves of the features, int64, shape :math:`(N,)`.
        descriptors: Descriptors of the features, uint8, shape :math:`(N, 32)`.
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: Maximum ratio of the best to the second-best distance among the candidates of a landmark.

    Returns:
        Pairs (landmark, feature), int64, shape :math:`(K, 2)`, sorted by landmark. Each landmark and each feature
        occurs at most once.
    """
    landmark, feature = _pairs_within(projected.T.contiguous().numpy(), radius.numpy(), uv.T.contiguous().numpy())
    is_near_octave = np.flatnonzero(np.abs(landmark_octave.numpy()[landmark] - octave.numpy()[feature]) <= 1)
    landmark, feature = landmark[is_near_octave], feature[is_near_octave]
    landmark_rows, feature_rows = (torch.from_numpy(rows) for rows in (landmark, feature))
    # index_select is faster than indexing here.
    distance = hamming_distance(
        landmark_descriptors.index_select(0, landmark_rows), descriptors.index_select(0, feature_rows)
    ).numpy()

    # Best and second-best candidate of each landmark.
    order = np.argsort(landmark * _MAX_DISTANCE + distance, kind="stable")
    landmark, feature, distance = landmark[order], feature[order], distance[order]
    second = np.append(np.where(landmark[1:] == landmark[:-1], distance[1:], np.inf), np.inf)[: len(order)]
    accepted = _is_first(landmark) & (distance <= max_hamming) & (distance <= max_ratio * second)
    landmark, feature, distance = landmark[accepted], feature[accepted], distance[accepted]

    # Best landmark of each feature; the lower index wins ties, so that the result is deterministic.
    order = np.lexsort((landmark, distance, feature))
    best = np.sort(order[_is_first(feature[order])])
    return torch.from_numpy(np.stack([landmark[best], feature[best]], axis=1))


def _is_first(values: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask of the first occurrence of each value in a sorted array, (N,)."""
    return np.concatenate([np.ones(len(values[:1]), dtype=np.bool_), values[1:] != values[:-1]])


def _pairs_within(
    centre: NDArray[np.float64], radius: NDArray[np.float64], uv: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of a centre (2, L) and a pixel (2, N) within its radius (L,), sorted by centre.

    The pixels are sorted by the cells of a grid, row by row, so that the pixels of neighbouring cells in a row are
    contiguous.
    """
    if not centre.size or not uv.size:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    origin = uv.min(axis=1, keepdims=True)
    column, row = _cells(uv - origin)
    last_column, last_row = column.max(), row.max()
    width, count = last_column + 1, len(row)
    key = row * width + column
    order = np.sort(key * count + np.arange(count)) % count  # an argsort by key; sorting numbers is faster
    begin = np.append(0, np.bincount(key, minlength=width * (last_row + 1)).cumsum())  # start of each cell in `order`
    (left, top), (right, bottom) = _cells(centre - origin - radius), _cells(centre - origin + radius)
    left, top = np.maximum(left, 0), np.maximum(top, 0)
    right, bottom = np.minimum(right, last_column), np.minimum(bottom, last_row)
    # One range of grid rows per centre, then one range of pixels per centre and grid row.
    centre_index, rows = _expand_ranges(top, np.where(left <= right, bottom + 1, top))
    rows *= width
    range_index, position = _expand_ranges(begin[rows + left[centre_index]], begin[rows + right[centre_index] + 1])
    centre_index, pixel = centre_index[range_index], order[position]
    u, v = (uv[axis].take(pixel) - centre[axis].take(centre_index) for axis in (0, 1))
    near = np.flatnonzero(u * u + v * v <= (radius * radius).take(centre_index))
    return centre_index[near], pixel[near]


def _cells(pixels: NDArray[np.float64]) -> NDArray[np.int64]:
    """Grid cells (column, row) of pixels relative to the grid's origin, both (2, N)."""
    with np.errstate(invalid="ignore"):  # nothing is near a projection that is NaN, whatever its cell
        return np.floor(pixels / CELL).astype(np.int64)


def _expand_ranges(first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Concatenate the integer ranges from ``first`` to before ``last``; returns range index and value of each entry."""
    count = np.maximum(last - first, 0)
    range_index = np.repeat(np.arange(len(count)), count)
    return range_index, np.arange(len(range_index)) - (count.cumsum() - count - first)[range_index]
