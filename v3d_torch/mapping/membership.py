"""Membership in a set of landmark ids or of indices of keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def contains(ids: NDArray[np.int64], queries: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Check which ids are in a set, by a lookup table because `numpy.isin` sorts.

    Args:
        ids: Ids in the set, -1 for none, int64, shape :math:`(L,)`.
        queries: Ids to check, -1 for none, int64, shape :math:`(N,)`.
        count: Number of landmarks, or of keyframes, in the map: exclusive upper bound of the ids.

    Returns:
        True for queries in the set, false for -1, bool, shape :math:`(N,)`.
    """
    table = np.zeros(count + 1, dtype=np.bool_)  # index -1 is the last entry
    table[ids] = True
    table[-1] = False
    return table.take(queries)
