"""Landmark ids: merging of duplicate landmarks, and compaction of the landmark table."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.kernels import landmark_fusion as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.mapping.map_tables import MapTables

_COMPACTION_RATIO = 2
"""Ratio of all landmarks to the landmarks in use above which the table is compacted."""


def merge_landmarks(tables: MapTables, kept: Tensor, merged: Tensor) -> None:
    """Merge pairs of landmarks, in place, unless one keyframe observes both landmarks of the pair.

    Args:
        tables: Data of the map.
        kept: Id of the landmark of each pair that remains, int64, shape :math:`(L,)`.
        merged: Id of the landmark of each pair that becomes inactive, int64, shape :math:`(L,)`. No id occurs twice
            in ``kept`` and ``merged``.
    """
    if len(kept) == 0:
        return
    # NumPy is faster than torch for these small arrays; they share the memory of the tables.
    keyframes, observed, features, valid = (
        tables.observations[name].numpy() for name in ("keyframe", "landmark", "feature", "valid")
    )
    counts = len(tables.keyframes), len(tables.landmarks)
    own, other = kept.numpy(), merged.numpy()
    is_mergeable, rows = _find_mergeable(own, other, keyframes, observed, valid, *counts)
    own, other = own[is_mergeable], other[is_mergeable]
    new_id = np.empty(len(tables.landmarks), np.int64)
    new_id[other] = own
    keyframe, feature, landmark = keyframes[rows], features[rows], new_id[observed[rows]]
    observed[rows] = landmark
    for index in np.flatnonzero(np.bincount(keyframe)):
        of_keyframe = keyframe == index
        tables.keyframes[index].landmarks.numpy()[feature[of_keyframe]] = landmark[of_keyframe]
    for counter in ("found", "visible"):
        matches = tables.landmarks[counter].numpy()
        matches[own] += matches[other]
    tables.landmarks["active"].numpy()[other] = False


@compiled_by(kernels.find_mergeable)
def _find_mergeable(
    kept: NDArray[np.int64],
    merged: NDArray[np.int64],
    keyframe: NDArray[np.int64],
    landmark: NDArray[np.int64],
    valid: NDArray[np.bool_],
    keyframe_count: int,
    landmark_count: int,
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Find the pairs of landmarks of which no keyframe observes both, and the observations of their second ones.

    Args:
        kept: Id of the first landmark of each pair, shape :math:`(P,)`.
        merged: Id of the second landmark of each pair, shape :math:`(P,)`. No id occurs twice in ``kept`` and
            ``merged``.
        keyframe: Keyframe of each observation, shape :math:`(M,)`.
        landmark: Landmark of each observation, shape :math:`(M,)`.
        valid: Mask of the observations that are not outliers, shape :math:`(M,)`.
        keyframe_count: Number of keyframes.
        landmark_count: Number of landmarks.

    Returns:
        Mask of the pairs, shape :math:`(P,)`, and rows of the observations, ascending, shape :math:`(R,)`.
    """
    pair_of = np.full(landmark_count, -1)
    pair_of[kept] = pair_of[merged] = np.arange(len(kept))
    rows = np.flatnonzero(valid & (pair_of.take(landmark) >= 0))
    pair = pair_of.take(landmark[rows])
    keys = np.sort(pair * keyframe_count + keyframe[rows])
    is_mergeable = np.ones(len(kept), np.bool_)
    is_mergeable[keys[1:][keys[1:] == keys[:-1]] // keyframe_count] = False
    return is_mergeable, rows[is_mergeable[pair] & (landmark[rows] == merged[pair])]


def compact_landmarks(tables: MapTables, external_ids: Iterable[Tensor]) -> None:
    """Remove the landmarks that are not in use from the table, if these are most of its rows.

    Memory and time then depend on the current size of the map, not on its history. The other landmarks get new ids in
    the order of the old ones; nothing else changes.

    Args:
        tables: Data of the map.
        external_ids: Landmark ids stored outside of the map, -1 for none, int64; updated in place.
    """
    external_ids = list(external_ids)
    in_use = find_landmarks_in_use(tables, external_ids)
    if len(in_use) <= _COMPACTION_RATIO * int(in_use.sum()):
        return
    tensors = [*_stored_ids(tables), *external_ids]
    distinct = {tensor.data_ptr(): tensor for tensor in tensors if len(tensor)}.values()  # tensors can share memory
    tables.landmarks.keep_rows(in_use)
    new_id = compacted_ids(in_use)
    for ids in distinct:
        ids.copy_(new_id[ids])


def find_landmarks_in_use(tables: MapTables, external_ids: Iterable[Tensor] = ()) -> Tensor:
    """Find the landmarks that are active or that an observation, a keyframe or another id refers to.

    Args:
        tables: Data of the map.
        external_ids: Landmark ids stored outside of the map, -1 for none, int64.

    Returns:
        Mask of the landmarks, bool, shape :math:`(L,)`.
    """
    in_use = torch.cat([tables.landmarks["active"], torch.tensor([False])])
    in_use[torch.cat([*_stored_ids(tables), *external_ids])] = True  # the last element is that of no landmark, -1
    return in_use[:-1]


def compacted_ids(in_use: Tensor) -> Tensor:
    """Return the new id of each landmark if only those in use remain, int64, shape :math:`(L + 1,)`.

    The last element is -1, so that indexing with -1, for no landmark, gives -1.

    Args:
        in_use: Mask of the landmarks, bool, shape :math:`(L,)`.
    """
    return torch.cat([in_use.cumsum(0) - 1, torch.tensor([-1])])


def _stored_ids(tables: MapTables) -> list[Tensor]:
    """Landmark ids stored in the map, -1 for none."""
    return [tables.observations["landmark"], *(keyframe.landmarks for keyframe in tables.active_keyframes)]
