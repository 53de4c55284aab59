"""Covisibility of keyframes: their common landmarks (ORB-SLAM, Mur-Artal et al., T-RO 2015, Sec. III-D)."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from torch import Tensor

from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.membership import contains


def count_shared_landmarks(tables: MapTables, landmarks: Tensor) -> Tensor:
    """Count the given landmarks that each keyframe observes.

    Args:
        tables: Data of the map.
        landmarks: Ids, int64, shape :math:`(L,)`.

    Returns:
        Number of shared landmarks of each keyframe, int64, shape :math:`(K,)`.
    """
    # NumPy is faster here than torch, and indices are faster than a mask.
    keyframe, landmark, valid = (tables.observations[name].numpy() for name in ("keyframe", "landmark", "valid"))
    is_given = contains(landmarks.numpy(), landmark, len(tables.landmarks))
    observers = keyframe[np.flatnonzero(is_given & valid)]
    return torch.from_numpy(np.bincount(observers, minlength=len(tables.keyframes)))


def covisible_keyframes(tables: MapTables, landmarks: Tensor, count: int) -> Tensor:
    """Find the keyframes that observe most of the given landmarks, best first.

    Args:
        tables: Data of the map.
        landmarks: Ids, int64, shape :math:`(L,)`.
        count: Maximum number of keyframes.

    Returns:
        Indices of keyframes that observe at least one of the landmarks, int64, shape :math:`(<= count,)`.
    """
    shared = count_shared_landmarks(tables, landmarks).numpy()
    score = shared * len(shared) + np.arange(len(shared))  # of equal counts, the newer keyframe is first
    order = np.argsort(-score)[:count]
    return torch.from_numpy(order[shared[order] > 0])


def landmarks_ever_observed(tables: MapTables, keyframes: Tensor) -> Tensor:
    """Find the landmarks that any of the given keyframes observes or observed.

    Observations that a bundle adjustment removed as outliers count, too: their landmarks are in view, and can be
    matched if other keyframes still observe them.

    Args:
        tables: Data of the map.
        keyframes: Indices of keyframes, int64, shape :math:`(K,)`.

    Returns:
        Ids, ascending, int64, shape :math:`(L,)`.
    """
    # Without the removed observations, tracking was less accurate where unmasked people move.
    keyframe, landmark = (tables.observations[name].numpy() for name in ("keyframe", "landmark"))
    observed = np.zeros(len(tables.landmarks), np.bool_)
    observed[landmark[np.flatnonzero(contains(keyframes.numpy(), keyframe, len(tables.keyframes)))]] = True
    return torch.from_numpy(np.flatnonzero(observed))


def covisibility_edges(tables: MapTables, min_shared: int) -> Tensor:
    """Find the edges of the pose graph: pairs of covisible keyframes, and pairs of consecutive active keyframes.

    There is no edge between consecutive keyframes of different parts of the map: their relative pose is unknown.

    Args:
        tables: Data of the map.
        min_shared: Minimum number of landmarks that a covisible pair shares.

    Returns:
        Pairs of keyframe indices (i, j), i < j, sorted, int64, shape :math:`(E, 2)`.
    """
    pairs = torch.cat([_covisible_pairs(tables, min_shared), _consecutive_pairs(tables)])
    return pairs.unique(dim=0)


def _covisible_pairs(tables: MapTables, min_shared: int) -> Tensor:
    observations = tables.observations
    valid = observations["valid"]
    keyframes, landmarks = observations["keyframe"][valid].numpy(), observations["landmark"][valid].numpy()
    shape = (len(tables.keyframes), len(tables.landmarks))
    observed = scipy.sparse.csr_array((np.ones(len(keyframes)), (keyframes, landmarks)), shape=shape)
    shared = scipy.sparse.triu(observed @ observed.T, k=1).tocoo()
    enough = shared.data >= min_shared
    return torch.from_numpy(np.stack([shared.row[enough], shared.col[enough]], axis=1).astype(np.int64))


def _consecutive_pairs(tables: MapTables) -> Tensor:
    active = tables.active_keyframes
    index = torch.tensor([keyframe.index for keyframe in active], dtype=torch.int64)
    part = torch.tensor([keyframe.part for keyframe in active], dtype=torch.int64)
    is_same = part[:-1] == part[1:]
    return torch.stack([index[:-1][is_same], index[1:][is_same]], dim=1)
