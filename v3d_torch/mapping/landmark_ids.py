"""Landmark ids: merging of duplicate landmarks, and compaction of the landmark table."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

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
