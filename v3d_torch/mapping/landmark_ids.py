"""Landmark IDs: merging of duplicate landmarks, and compaction of the landmark table."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from v3d_torch.mapping.map_tables import MapTables

_MAX_LANDMARKS_PER_OBSERVATION = 2
"""Ratio of landmarks to observations above which the table is compacted. Every active landmark has at least one
observation, so above this ratio more than half of the landmarks are inactive."""


def merge_landmarks(tables: MapTables, kept: Tensor, merged: Tensor) -> None:
    """Merge pairs of landmarks, in place, unless one keyframe observes both landmarks of the pair.

    Args:
        tables: Data of the map.
        kept: ID of the landmark of each pair that remains, int64, shape :math:`(L,)`.
        merged: ID of the landmark of each pair that becomes inactive, int64, shape :math:`(L,)`. No ID occurs twice
            in ``kept`` and ``merged``.
    """
    if len(kept) == 0:
        return
    # NumPy is faster than torch for these small arrays; they share the memory of the tables.
    keyframes, observed, features, valid = (
        tables.observations[name].numpy() for name in ("keyframe", "landmark", "feature", "valid")
    )
    own, other, count = kept.numpy(), merged.numpy(), len(tables.landmarks)
    new_id, affected = np.arange(count), np.zeros(count, dtype=np.bool_)
    new_id[other] = own
    affected[own] = affected[other] = True
    rows = np.flatnonzero(valid & affected.take(observed))
    keyframe, landmark = keyframes[rows], observed[rows]

    # If one keyframe observes both landmarks of a pair, they are distinct points.
    keys = np.sort(keyframe * count + new_id[landmark])
    is_distinct = np.zeros(count, dtype=np.bool_)
    is_distinct[keys[1:][keys[1:] == keys[:-1]] % count] = True
    distinct = is_distinct[own]
    new_id[other[distinct]] = other[distinct]
    own, other = own[~distinct], other[~distinct]

    changed = new_id[landmark] != landmark
    rows, keyframe, landmark = rows[changed], keyframe[changed], new_id[landmark[changed]]
    observed[rows] = landmark
    feature = features[rows]
    for index in np.flatnonzero(np.bincount(keyframe)):
        of_keyframe = keyframe == index
        tables.keyframes[index].landmarks.numpy()[feature[of_keyframe]] = landmark[of_keyframe]
    for counter in ("found", "visible"):
        matches = tables.landmarks[counter].numpy()
        matches[own] += matches[other]
    tables.landmarks["active"].numpy()[other] = False


def compact_landmarks(tables: MapTables, external_ids: Iterable[Tensor]) -> None:
    """Remove inactive, unreferenced landmarks from the table, if most of its rows are unused.

    Memory and time then depend on the current size of the map, not on its history. The other landmarks get new IDs in
    the order of the old ones; nothing else changes.

    Args:
        tables: Data of the map.
        external_ids: Landmark IDs stored outside of the map, -1 for none, int64; updated in place.
    """
    if len(tables.landmarks) <= _MAX_LANDMARKS_PER_OBSERVATION * len(tables.observations):
        return
    tensors = [
        tables.observations["landmark"],
        *(keyframe.landmarks for keyframe in tables.keyframes),
        *external_ids,
    ]
    distinct = {tensor.data_ptr(): tensor for tensor in tensors if len(tensor)}.values()  # tensors can share memory
    needed = tables.landmarks["active"].clone()
    for ids in distinct:
        needed[ids[ids >= 0]] = True
    tables.landmarks.keep_rows(needed)
    new_id = needed.cumsum(0) - 1
    for ids in distinct:
        ids.copy_(torch.where(ids >= 0, new_id[ids], -1))
