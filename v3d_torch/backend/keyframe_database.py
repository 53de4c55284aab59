"""Place recognition without a vocabulary: keyframes vote by descriptors that nearly equal those of a new view.

In the manner of DBoW2 (Galvez-Lopez and Tardos, T-RO 2012), with hash buckets of ORB descriptors in place of words.
"""

from __future__ import annotations

from collections.abc import Iterable

import faiss
import numpy as np
from torch import Tensor


class KeyframeDatabase:
    """Remembers keyframes by their descriptors; grows and shrinks with the map, needs no training.

    A descriptor of the query votes for every keyframe that has one in the same bucket (equal first 16 bits) that
    differs in less than 50 of all 256. Votes weigh as words do in text retrieval: what every keyframe shows tells no
    place from another.
    """

    _KEY_BITS = 16  # finds as many places as the exhaustive search does (20 finds fewer) in a hundredth of the time
    _RADIUS = 50  # bits: nearly the same patch from nearly the same view (ORB-SLAM's TH_LOW)

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._index = faiss.IndexBinaryHash(256, self._KEY_BITS)
        self._descriptors: dict[int, Tensor] = {}  # of each keyframe, those forgotten among them
        self._owner = np.zeros(0, dtype=np.int64)  # position there of the keyframe that each descriptor is from
        self._forgotten: set[int] = set()

    def __len__(self) -> int:
        return len(self._descriptors) - len(self._forgotten)

    def add(self, keyframe: int, descriptors: Tensor) -> None:
        """Remember a keyframe.

        Args:
            keyframe: its id, not added before.
            descriptors: uint8, shape :math:`(N, 32)`.
        """
        self._index.add(descriptors.contiguous().numpy())
        self._owner = np.concatenate([self._owner, np.full(descriptors.shape[0], len(self._descriptors))])
        self._descriptors[keyframe] = descriptors

    def remove(self, keyframes: Iterable[int]) -> None:
        """Forget keyframes, also such as were never added."""
        self._forgotten |= self._descriptors.keys() & set(keyframes)
        if len(self._forgotten) > len(self):  # nothing can be taken out of the index: made anew, it stays as small
            kept = {index: own for index, own in self._descriptors.items() if index not in self._forgotten}
            self._begin()
            for index, own in kept.items():
                self.add(index, own)

    def query(self, descriptors: Tensor, k: int, exclude: Iterable[int] = ()) -> list[tuple[int, float]]:
        """Keyframes that most likely show the same place.

        Args:
            descriptors: of the view, uint8, shape :math:`(N, 32)`.
            k: most keyframes.
            exclude: ids that do not count, such as recent or covisible keyframes.

        Returns:
            (id, score) with score > 0, best first, the older first where scores are equal. The score is the mean vote
            of a descriptor; it ranks within one query and is no probability.
        """
        ids = np.array(list(self._descriptors), dtype=np.int64)
        count, known = len(ids), ~np.isin(ids, list(self._forgotten))
        if len(self) == 0 or descriptors.shape[0] == 0:
            return []
        bounds, _, found = self._index.range_search(descriptors.contiguous().numpy(), self._RADIUS)
        voter, owner = np.repeat(np.arange(descriptors.shape[0]), np.diff(bounds).astype(np.int64)), self._owner[found]
        # A descriptor has one vote for each keyframe, however often a pattern repeats in it.
        voter, keyframe = np.divmod(np.unique((voter * count + owner)[known[owner]]), count)
        weight = np.log1p(len(self) / np.bincount(voter, minlength=1)[voter])
        score = np.bincount(keyframe, weights=weight, minlength=count) / descriptors.shape[0]
        score[np.isin(ids, list(exclude))] = 0.0
        order = np.argsort(-score, kind="stable")[:k]
        return [(int(ids[i]), float(score[i])) for i in order if score[i] > 0]
