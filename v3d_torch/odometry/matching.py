"""Matching of binary descriptors: everywhere, or only near where a landmark should appear."""

from __future__ import annotations

import faiss
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_CELL = 8.0
"""Side of the cells in which features are looked up, pixels: about half a search radius."""


def hamming(a: Tensor, b: Tensor) -> Tensor:
    """Hamming distance of descriptors row by row.

    Args:
        a: uint8, shape :math:`(N, 32)`.
        b: uint8, shape :math:`(N, 32)`.

    Returns:
        Bits that differ, int64, shape :math:`(N,)`.
    """
    differing = np.bitwise_xor(a.contiguous().numpy().view(np.uint64), b.contiguous().numpy().view(np.uint64))
    return torch.from_numpy(np.bitwise_count(differing).sum(axis=1, dtype=np.int64))


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
    landmark, feature = _near(projected, radius, uv)
    alike = (levels[landmark] - octave[feature]).abs() <= 1
    landmark, feature = landmark[alike], feature[alike]
    if landmark.shape[0] == 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    distance = hamming(descriptors[landmark], candidates[feature])

    infinite = 1 << 20
    best = torch.full((projected.shape[0],), infinite).scatter_reduce_(0, landmark, distance, "amin")
    is_best = distance == best[landmark]
    second = torch.full((projected.shape[0],), infinite)
    second = second.scatter_reduce_(0, landmark, torch.where(is_best, infinite, distance), "amin")
    tied = torch.zeros(projected.shape[0], dtype=torch.int64).scatter_add_(0, landmark, is_best.long()) > 1
    second = torch.where(tied, best, second)
    keep = is_best & (distance <= max_hamming) & (distance <= max_ratio * second[landmark])
    landmark, feature, distance = landmark[keep], feature[keep], distance[keep]

    # A feature goes to the landmark it resembles most; ties to the lower index, so that the order is defined.
    rank = distance * projected.shape[0] + landmark
    winner = torch.full((uv.shape[0],), rank.max().item() + 1 if rank.shape[0] else 0)
    winner = winner.scatter_reduce_(0, feature, rank, "amin")
    keep = rank == winner[feature]
    return torch.stack([landmark[keep], feature[keep]], dim=1)


def _near(centre: Tensor, radius: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Every pair of a centre (L, 2) and a place (N, 2) within its radius (L,), sorted by centre.

    Places are sorted into the cells of a grid: those of neighbouring cells of a row stand side by side.
    """
    if not len(centre) or not len(uv):
        none = torch.zeros(0, dtype=torch.int64)
        return none, none
    origin = uv.amin(dim=0)
    last_column, last_row = _cell(uv.amax(dim=0), origin).tolist()
    column, row = _cell(uv, origin).unbind(dim=1)
    key, order = torch.sort(row * (last_column + 1) + column)
    low, high = _cell(centre - radius[:, None], origin), _cell(centre + radius[:, None], origin)
    beside = torch.zeros(2, dtype=torch.int64), torch.tensor([last_column, last_row])
    in_grid = ((high >= beside[0]) & (low <= beside[1])).all(dim=1)
    (left, top), (right, bottom) = (cells.clamp(*beside).unbind(dim=1) for cells in (low, high))
    owner, rows = _ranges(top, torch.where(in_grid, bottom + 1, top))
    first, last = (rows * (last_column + 1) + cells[owner] for cells in (left, right))
    of_owner, place = _ranges(torch.searchsorted(key, first), torch.searchsorted(key, last, right=True))
    owner = owner[of_owner]
    # Column by column: a gather of pairs, and the sum of each, would take three times as long.
    off = ((uv[order, axis])[place] - centre[:, axis].contiguous()[owner] for axis in (0, 1))
    near = sum(difference * difference for difference in off) <= radius.square()[owner]
    return owner[near], order[place[near]]


def _cell(places: Tensor, origin: Tensor) -> Tensor:
    return ((places - origin) / _CELL).floor().to(torch.int64)


def _ranges(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """The numbers from ``first`` to before ``last`` of every row, one row after the other, and whose they are."""
    count = last - first
    owner = torch.arange(len(first)).repeat_interleave(count)
    return owner, torch.arange(len(owner)) - (count.cumsum(0) - count - first)[owner]
