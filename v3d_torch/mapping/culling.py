"""Culling of landmarks and keyframes (ORB-SLAM2, local mapping: MapPointCulling and KeyFrameCulling).

A camera that stays in one room keeps creating keyframes. A keyframe adds little information if enough other keyframes
observe its landmarks, but costs memory and time in every bundle adjustment.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.config import MappingConfig
from v3d_torch.mapping.covisibility import covisible_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.membership import contains

_MIN_FOUND_RATIO = 0.25
"""Minimum ratio of frames that matched a landmark to frames that should have matched it (ORB-SLAM2)."""

_CONFIRMATION_KEYFRAMES = 3
"""Number of later keyframes within which a second keyframe must observe a landmark (ORB-SLAM2)."""

_MIN_OBSERVATIONS = 2
"""Number of observations of a confirmed landmark: by the keyframe that created it and by another keyframe."""


def cull_landmarks(tables: MapTables) -> None:
    """Cull landmarks with a low found ratio, and landmarks that no second keyframe has observed, in place.

    The found ratio of a landmark is checked once a later keyframe exists.

    Args:
        tables: Data of the map.
    """
    landmarks, observations = tables.landmarks, tables.observations
    age = len(tables.keyframes) - 1 - landmarks["keyframe"].numpy()
    observed = observations["landmark"].numpy()[observations["valid"].numpy()]
    observers = np.bincount(observed, minlength=len(landmarks))
    found, visible = landmarks["found"].numpy(), landmarks["visible"].numpy()
    low_found_ratio = found < _MIN_FOUND_RATIO * visible
    unconfirmed = (age == _CONFIRMATION_KEYFRAMES) & (observers < _MIN_OBSERVATIONS)
    landmarks["active"].numpy()[(low_found_ratio & (age > 0)) | unconfirmed] = False


def cull_keyframes(tables: MapTables, references: Mapping[int, int]) -> None:
    """Cull the given keyframes, in place: remove their observations and attach their poses to other keyframes.

    Landmarks without an observation become inactive.

    Args:
        tables: Data of the map.
        references: Index of the reference keyframe of each culled keyframe, by the index of the culled keyframe.
    """
    for keyframe in tables.keyframes:
        keyframe.reference = references.get(keyframe.reference, keyframe.reference)
    culled, empty = torch.tensor(list(references)), torch.zeros(0, dtype=torch.int64)
    for index in references:
        keyframe = tables.keyframes[index]
        keyframe.features, keyframe.landmarks = keyframe.features[empty], empty
    observations = tables.observations
    observations.keep_rows(observations["valid"] & ~torch.isin(observations["keyframe"], culled))
    observed = torch.bincount(observations["landmark"], minlength=len(tables.landmarks)) > 0
    tables.landmarks["active"][~observed] = False


def cull_redundant_keyframes(tables: MapTables, newest: Keyframe, config: MappingConfig) -> None:
    """Cull redundant neighbours of a new keyframe, in place.

    The first keyframe stays, because it defines the world frame.

    Args:
        tables: Data of the map.
        newest: The new keyframe.
        config: Criterion of redundancy, and size of the neighbourhood.
    """
    neighbours = covisible_keyframes(tables, newest.observed_landmarks, config.bundle_keyframes).tolist()
    neighbourhood = _Neighbourhood(tables, neighbours)
    references: dict[int, int] = {}
    ratios = neighbourhood.redundant_ratios(config.redundant_views)
    for index in neighbours:
        if index in (0, newest.index) or ratios[index] <= config.redundant_ratio:
            continue
        references[index] = neighbourhood.most_covisible(index)
        neighbourhood.remove(index)
        ratios = neighbourhood.redundant_ratios(config.redundant_views)
        # A reference keyframe can itself be culled later.
        references = {culled: references.get(reference, reference) for culled, reference in references.items()}
    if references:
        cull_keyframes(tables, references)


class _Neighbourhood:
    """All observations of the landmarks that some keyframes observe."""

    def __init__(self, tables: MapTables, keyframes: list[int]) -> None:
        names = "keyframe", "landmark", "octave", "valid"
        keyframe, landmark, octave, valid = (tables.observations[name].numpy() for name in names)
        self._keyframe_count = len(tables.keyframes)
        usable = valid & tables.landmarks["active"].numpy().take(landmark)
        by_keyframes = usable & contains(np.array(keyframes, np.int64), keyframe, self._keyframe_count)
        is_observed = np.zeros(len(tables.landmarks), np.bool_)
        is_observed[landmark[np.flatnonzero(by_keyframes)]] = True
        rows = np.flatnonzero(usable & is_observed.take(landmark))
        # Number the observed landmarks only, so that time does not depend on the size of the map.
        number = is_observed.cumsum() - 1
        self._landmark_count = int(np.count_nonzero(is_observed))
        self._keyframe, self._octave, self._landmark = keyframe[rows], octave[rows], number[landmark[rows]]
        self._levels = int(self._octave.max()) + 1 if len(self._octave) else 1

    def redundant_ratios(self, min_views: int) -> NDArray[np.float64]:
        """Ratio of each keyframe's landmarks that enough other keyframes observe at the next octave or a finer one."""
        cell = self._landmark * self._levels + self._octave
        counts = np.bincount(cell, minlength=self._landmark_count * self._levels)
        up_to_octave = counts.reshape(-1, self._levels).cumsum(axis=1)
        others = up_to_octave[self._landmark, np.minimum(self._octave + 1, self._levels - 1)] - 1
        redundant = np.bincount(self._keyframe[others >= min_views], minlength=self._keyframe_count)
        return redundant / np.bincount(self._keyframe, minlength=self._keyframe_count).clip(min=1)

    def most_covisible(self, keyframe: int) -> int:
        """Return the other keyframe that shares most landmarks with the given one; the newest of several."""
        own = self._landmark[self._keyframe == keyframe]
        shared = np.bincount(self._keyframe[contains(own, self._landmark, self._landmark_count)])
        shared[keyframe] = 0
        return int((shared * len(shared) + np.arange(len(shared))).argmax())

    def remove(self, keyframe: int) -> None:
        """Remove the observations of a keyframe."""
        others = self._keyframe != keyframe
        self._keyframe, self._octave, self._landmark = (
            self._keyframe[others],
            self._octave[others],
            self._landmark[others],
        )
