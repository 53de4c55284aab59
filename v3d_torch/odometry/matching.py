"""Matching of binary descriptors: everywhere, or only near where a landmark should appear."""

from __future__ import annotations

import kornia_rs
import numpy as np
import torch
from torch import Tensor


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
    pairs = kornia_rs.features.match_descriptors(
        a.contiguous().numpy(),
        b.contiguous().numpy(),
        max_distance=max_hamming,
        cross_check=True,
        max_ratio=max_ratio,
    )
    return torch.from_numpy(pairs.reshape(-1, 2))


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
    # Float32 distances are good to 0.1 pixel, enough to choose candidates, and four times as fast as a float64 test.
    near = torch.cdist(projected.to(torch.float32), uv.to(torch.float32)) <= radius.to(torch.float32)[:, None]
    near &= (levels[:, None] - octave[None, :]).abs() <= 1
    landmark, feature = torch.nonzero(near, as_tuple=True)
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
