"""Matching of binary descriptors: everywhere, or only near where a landmark should appear."""

from __future__ import annotations

import faiss
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_CELL = 8.0
"""Side of the cells in which features are looked up, pixels: about half a search radius."""

_BITS = 1 << 9
"""More than descriptors differ by."""


def hamming(a: Tensor, b: Tensor) -> Tensor:
    """Hamming distance of descriptors row by row.

    Args:
        a: uint8, shape :math:`(N, 32)`.
        b: uint8, shape :math:`(N, 32)`.

    Returns:
        Bits that differ, int64, shape :math:`(N,)`.
    """
    return torch.from_numpy(np.bitwise_count(_words(a) ^ _words(b))).sum(dim=1)


def _words(descriptors: Tensor) -> NDArray[np.uint64]:
    """Descriptors (N, 32) as four numbers each, (N, 4)."""
    return descriptors.contiguous().numpy().view(np.uint64)


def match_descriptors(a: Tensor, b: Tensor, *, max_hamming: int, max_ratio: float) -> Tensor:
    """Mutual nearest neighbours that pass Lowe's ratio test.

    Args:
        a: uint8, shape :math:`(N, 32)`.
        b: uint8, shape :math:`(M, 32)`.
        max_hamming: greatest distance, bits.
        max_ratio: best over second best distance.

    Returns:
        Pairs (row of ``a``, row of ``b``), int64, shape :math:`(K, 2)`.
    """
    if min(a.shape[0], b.shape[0]) < 2:
        return torch.zeros(0, 2, dtype=torch.int64)
    ours, theirs = a.numpy(), b.numpy()
    distance, nearest = _flat(theirs).search(ours, 2)
    clear = np.flatnonzero((distance[:, 0] <= max_hamming) & (distance[:, 0] < max_ratio * distance[:, 1]))
    found = nearest[clear, 0]
    # Mutual: only what somebody found is looked for the other way round.
    looked_up, which = np.unique(found, return_inverse=True)
    _, back = _flat(ours).search(theirs[looked_up], 1)
    mutual = back[which, 0] == clear
    return torch.from_numpy(np.stack([clear[mutual], found[mutual]], axis=1))


def _flat(descriptors: NDArray[np.uint8]) -> faiss.IndexBinaryFlat:
    """An exhaustive index of descriptors, (N, 32): a quarter of the time that kornia-rs's matcher takes."""
    index = faiss.IndexBinaryFlat(8 * descriptors.shape[1])
    index.add(descriptors)
    return index


def match_near(
    projected: Tensor,
    radius: Tensor,
    levels: Tensor,
    descriptors: Tensor,
    uv: Tensor,
    octave: Tensor,
    candidates: Tensor,
    *,
    max_hamming: int,
    max_ratio: float,
) -> Tensor:
    """Match landmarks to the features near their projections (Mur-Artal and Tardos, ORB-SLAM2, Sec. III).

    Args:
        projected: where each landmark should appear, pixels, shape :math:`(L, 2)`.
        radius: how far around it to look, pixels, shape :math:`(L,)`.
        levels: expected pyramid level of each landmark, int64, shape :math:`(L,)`; one level off is accepted.
        descriptors: of the landmarks, uint8, shape :math:`(L, 32)`.
        uv: pixels of the features, shape :math:`(N, 2)`.
        octave: levels of the features, int64, shape :math:`(N,)`.
        candidates: descriptors of the features, uint8, shape :math:`(N, 32)`.
        max_hamming: greatest distance, bits.
        max_ratio: best over second best distance among the candidates of one landmark.

    Returns:
        Pairs (landmark, feature), each at most once, int64, shape :math:`(K, 2)`, sorted by landmark.
    """
    landmark, feature = _near(projected.T.contiguous().numpy(), radius.numpy(), uv.T.contiguous().numpy())
    alike = np.flatnonzero(np.abs(levels.numpy()[landmark] - octave.numpy()[feature]) <= 1)
    landmark, feature = landmark[alike], feature[alike]
    ours, theirs = (torch.from_numpy(of_each) for of_each in (landmark, feature))
    # Rows by index_select: plain indexing takes nine times as long for them.
    distance = hamming(descriptors.index_select(0, ours), candidates.index_select(0, theirs)).numpy()

    # The best of each landmark, and the second best; the pairs come sorted by landmark.
    order = np.argsort(landmark * _BITS + distance, kind="stable")
    landmark, feature, distance = landmark[order], feature[order], distance[order]
    following = np.append(np.where(landmark[1:] == landmark[:-1], distance[1:], np.inf), np.inf)[: len(order)]
    clear = _first(landmark) & (distance <= max_hamming) & (distance <= max_ratio * following)
    landmark, feature, distance = landmark[clear], feature[clear], distance[clear]

    # A feature goes to the landmark it resembles most; ties to the lower index, so that the order is defined.
    order = np.lexsort((landmark, distance, feature))
    kept = np.sort(order[_first(feature[order])])
    return torch.from_numpy(np.stack([landmark[kept], feature[kept]], axis=1))


def _first(ordered: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Where a number stands for the first time in a sorted row of them, (N,)."""
    return np.concatenate([np.ones(len(ordered[:1]), dtype=np.bool_), ordered[1:] != ordered[:-1]])


def _near(
    centre: NDArray[np.float64], radius: NDArray[np.float64], uv: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Every pair of a centre (2, L) and a place (2, N) within its radius (L,), sorted by centre.

    Places are sorted into the cells of a grid: those of neighbouring cells of a row stand side by side.
    """
    if not centre.size or not uv.size:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    origin = uv.min(axis=1, keepdims=True)
    column, row = _cell(uv - origin)
    last_column, last_row = column.max(), row.max()
    width, count = last_column + 1, len(row)
    key = row * width + column
    order = np.sort(key * count + np.arange(count)) % count  # by key: numbers sort five times as fast as indices
    begin = np.append(0, np.bincount(key, minlength=width * (last_row + 1)).cumsum())  # of each cell in that order
    (left, top), (right, bottom) = _cell(centre - origin - radius), _cell(centre - origin + radius)
    left, top = np.maximum(left, 0), np.maximum(top, 0)
    right, bottom = np.minimum(right, last_column), np.minimum(bottom, last_row)
    owner, rows = _ranges(top, np.where(left <= right, bottom + 1, top))
    rows *= width
    of_owner, place = _ranges(begin[rows + left[owner]], begin[rows + right[owner] + 1])
    owner, place = owner[of_owner], order[place]
    u, v = (uv[axis].take(place) - centre[axis].take(owner) for axis in (0, 1))
    near = np.flatnonzero(u * u + v * v <= (radius * radius).take(owner))
    return owner[near], place[near]


def _cell(places: NDArray[np.float64]) -> NDArray[np.int64]:
    """Columns and rows of the cells that places, counted from the first, are in, both (2, N)."""
    return np.floor(places / _CELL).astype(np.int64)


def _ranges(first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The numbers from ``first`` to before ``last`` of every row, one row after the other, and whose they are."""
    count = np.maximum(last - first, 0)
    owner = np.repeat(np.arange(len(count)), count)
    return owner, np.arange(len(owner)) - (count.cumsum() - count - first)[owner]
