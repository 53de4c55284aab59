"""Keyframes that the map can do without (ORB-SLAM2, local mapping: keyframe culling).

A camera that stays in a room makes keyframes for as long as it looks. One whose landmarks enough others see as well
tells nothing new, but costs memory, and time in each adjustment.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import MappingConfig
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.tensor_table import unique_ids


def cull_redundant_keyframes(sparse_map: SparseMap, newest: Keyframe, config: MappingConfig) -> None:
    """Retire the neighbours of a new keyframe that are redundant by now; never the first, which fixes the world.

    Args:
        sparse_map: whose keyframes and observations are changed in place.
        newest: the new keyframe.
        config: when a keyframe is redundant.
    """
    neighbours = sparse_map.covisible_keyframes(newest.landmark_ids, config.bundle_keyframes).tolist()
    around = _Neighbourhood(sparse_map, neighbours)
    references: dict[int, int] = {}
    shares = around.redundancy(config.redundant_views)
    for index in neighbours:
        if index in (0, newest.index) or shares[index] <= config.redundant_ratio:
            continue
        references[index] = around.nearest(index)
        around.drop(index)
        shares = around.redundancy(config.redundant_views)
        references = {gone: references.get(reference, reference) for gone, reference in references.items()}
    if references:
        sparse_map.cull_keyframes(references)


class _Neighbourhood:
    """Who sees the landmarks of some keyframes."""

    def __init__(self, sparse_map: SparseMap, keyframes: list[int]) -> None:
        table = sparse_map.observations
        usable = table["valid"] & sparse_map.landmarks["alive"][table["landmark"]]
        theirs = torch.zeros(len(sparse_map.landmarks), dtype=torch.bool)
        theirs[table["landmark"][usable & torch.isin(table["keyframe"], torch.tensor(keyframes))]] = True
        rows = usable & theirs[table["landmark"]]
        self._keyframe, self._octave = table["keyframe"][rows], table["octave"][rows]
        landmarks, self._landmark = unique_ids(table["landmark"][rows], len(sparse_map.landmarks))
        self._landmarks = len(landmarks)
        self._levels, self._keyframes = sparse_map.features.levels, len(sparse_map.keyframes)

    def redundancy(self, views: int) -> Tensor:
        """Share of each keyframe's landmarks that so many others see on its level of scale, the next or a finer one."""
        place = self._landmark * self._levels + self._octave
        counts = torch.bincount(place, minlength=self._landmarks * self._levels)
        up_to = counts.view(-1, self._levels).cumsum(dim=1)
        others = up_to[self._landmark, (self._octave + 1).clamp(max=self._levels - 1)] - 1
        enough = torch.bincount(self._keyframe[others >= views], minlength=self._keyframes)
        return enough / torch.bincount(self._keyframe, minlength=self._keyframes).clamp(min=1)

    def nearest(self, keyframe: int) -> int:
        """The other keyframe that shares most landmarks with one; of those that share as many, the newest."""
        others = self._keyframe[torch.isin(self._landmark, self._landmark[self._keyframe == keyframe])]
        shared = torch.bincount(others)
        shared[keyframe] = 0
        return int((shared * len(shared) + torch.arange(len(shared))).argmax())

    def drop(self, keyframe: int) -> None:
        """Go on without a keyframe."""
        kept = self._keyframe != keyframe
        self._keyframe, self._octave, self._landmark = self._keyframe[kept], self._octave[kept], self._landmark[kept]
