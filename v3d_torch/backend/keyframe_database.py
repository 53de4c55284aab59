"""Place recognition without a vocabulary, by the number of similar ORB descriptors.

The scoring follows DBoW2 (Galvez-Lopez and Tardos, T-RO 2012), with hash buckets of descriptors in place of visual
words.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

import faiss
import numpy as np
from torch import Tensor

_DESCRIPTOR_BITS = 256
"""Length of an ORB descriptor, bits."""

_KEY_BITS = 16
"""Number of leading bits of a descriptor that select its hash bucket. With fewer bits, buckets are larger and the
search is slower; with more bits, descriptors of one landmark are more often in different buckets."""

_MAX_DISTANCE = 50
"""Hamming distance below which two descriptors match, bits: the same patch from a similar view (TH_LOW of ORB-SLAM)."""


class KeyframeDatabase:
    """Database of keyframes that is queried by descriptors; it needs no training.

    The score of a keyframe is the sum of the weights of the descriptors of the query that match one of its descriptors:
    in the same hash bucket, and with a Hamming distance below a threshold. The weight is that of text retrieval, the
    inverse document frequency: descriptors that match many keyframes contribute little.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._index = faiss.IndexBinaryHash(_DESCRIPTOR_BITS, _KEY_BITS)
        self._descriptors: dict[int, Tensor] = {}  # by keyframe id, in the order of the index, with removed keyframes
        self._indexed = 0  # number of keyframes in the index, see `index_keyframes`
        self._owner = np.zeros(0, dtype=np.int64)  # for each descriptor in the index, position of its keyframe
        self._removed: set[int] = set()

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self._descriptors) - len(self._removed)

    def add(self, keyframe: int, descriptors: Tensor) -> None:
        """Add a keyframe.

        Args:
            keyframe: Id of the keyframe, not added before.
            descriptors: ORB descriptors of the keyframe, uint8, shape :math:`(N, 32)`.
        """
        self._descriptors[keyframe] = descriptors

    def index_keyframes(self) -> None:
        """Add the descriptors of new keyframes to the index; `query` does so, too, but then takes longer."""
        for position, own in islice(enumerate(self._descriptors.values()), self._indexed, None):
            self._index.add(own.contiguous().numpy())
            self._owner = np.concatenate([self._owner, np.full(own.shape[0], position)])
        self._indexed = len(self._descriptors)

    def remove(self, keyframes: Iterable[int]) -> None:
        """Remove keyframes, given by their ids; ids that are not in the database are ignored."""
        self._removed |= self._descriptors.keys() & set(keyframes)
        # The index cannot delete descriptors: rebuild it when most of its keyframes are removed.
        if len(self._removed) > len(self):
            active = {index: own for index, own in self._descriptors.items() if index not in self._removed}
            self._clear()
            self._descriptors = active

    def query(self, descriptors: Tensor, k: int, exclude: Iterable[int] = ()) -> list[tuple[int, float]]:
        """Find the keyframes that most likely observe the same place.

        Args:
            descriptors: ORB descriptors of the query image, uint8, shape :math:`(N, 32)`.
            k: Maximum number of keyframes.
            exclude: Ids of keyframes that are not returned, such as recent or covisible ones.

        Returns:
            Pairs (id, score) with score > 0, best first; of equal scores, the keyframe added earlier is first. The
            score is divided by the number of descriptors. It ranks the keyframes of one query; it is not a probability.
        """
        self.index_keyframes()
        ids = np.array(list(self._descriptors), dtype=np.int64)
        count, is_active = len(ids), ~np.isin(ids, list(self._removed))
        if len(self) == 0 or descriptors.shape[0] == 0:
            return []
        bounds, _, matches = self._index.range_search(descriptors.contiguous().numpy(), _MAX_DISTANCE)
        descriptor = np.repeat(np.arange(descriptors.shape[0]), np.diff(bounds).astype(np.int64))
        owner = self._owner[matches]
        # A descriptor counts once for each keyframe, even if it matches several descriptors of that keyframe.
        descriptor, keyframe = np.divmod(np.unique((descriptor * count + owner)[is_active[owner]]), count)
        weight = np.log1p(len(self) / np.bincount(descriptor, minlength=1)[descriptor])
        score = np.bincount(keyframe, weights=weight, minlength=count) / descriptors.shape[0]
        score[np.isin(ids, list(exclude))] = 0.0
        order = np.argsort(-score, kind="stable")[:k]
        return [(int(ids[i]), float(score[i])) for i in order if score[i] > 0]
