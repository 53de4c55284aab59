"""Landmarks found again in the keyframes around a new one (ORB-SLAM2, local mapping).

A keyframe makes landmarks of what tracking did not recognise. Many of them its neighbours see as well, as a feature
without a landmark or as a landmark of their own; joined, they tie the keyframes together where else each would hang on
its own depth image.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import Config
from v3d_torch.mapping.local_map import Keyframe, SparseMap, poses_of
from v3d_torch.odometry.guided import GuidedSearch
from v3d_torch.odometry.orb import Features
from v3d_torch.odometry.refine import chi_square, measurements, reprojection


class NeighbourSearch:
    """Joins the landmarks of a new keyframe with those of its neighbours.

    Args:
        config: of the whole system.
        camera: of the keyframes.
    """

    def __init__(self, config: Config, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._search = GuidedSearch(config.tracking, config.features, camera)

    def __call__(self, sparse_map: SparseMap, keyframe: Keyframe) -> None:
        """Look for the landmarks of a keyframe in its neighbours, and for theirs in it.

        Args:
            sparse_map: whose landmarks and observations are changed in place.
            keyframe: the newest.
        """
        covisible = sparse_map.covisible(keyframe.seen, self._config.mapping.fuse_keyframes + 1).tolist()
        neighbours = [sparse_map.keyframes[index] for index in covisible if index != keyframe.index]
        if neighbours:
            self._join(sparse_map, keyframe.seen, neighbours)
            self._join(sparse_map, torch.cat([neighbour.seen for neighbour in neighbours]).unique(), [keyframe])

    def _join(self, sparse_map: SparseMap, landmarks: Tensor, keyframes: Sequence[Keyframe]) -> None:
        """Let keyframes show those landmarks that they see without knowing."""
        now = torch.arange(len(sparse_map.landmarks))  # what each has become with the keyframes before
        for keyframe, found in zip(keyframes, self._find(sparse_map, landmarks, keyframes), strict=True):
            # Two that were found may have become one: it is behind the first of the features.
            _, first = np.unique(torch.where(found >= 0, now[found], -1), return_index=True)
            once = torch.full_like(found, -1).index_copy_(0, torch.from_numpy(first), found[first])
            now = sparse_map.fuse(keyframe, torch.where(once >= 0, now[once], -1))[now]

    def _find(self, sparse_map: SparseMap, landmarks: Tensor, keyframes: Sequence[Keyframe]) -> Sequence[Tensor]:
        """Which of the landmarks turns out to be behind each feature of each keyframe, -1 for none known before."""
        config, local, T_cw = self._config, sparse_map.look_up(landmarks.sort().values), poses_of(keyframes)
        features, counts = _joined(keyframes), [len(keyframe.features) for keyframe in keyframes]
        view = torch.arange(len(keyframes)).repeat_interleave(torch.tensor(counts))
        known = torch.zeros(len(keyframes), len(sparse_map.landmarks) + 1, dtype=torch.bool)
        known[view, torch.cat([keyframe.landmarks for keyframe in keyframes])] = True  # the last: features without one
        seen = self._search.project(T_cw, local)
        seen = seen[~known[seen.view, local.ids[seen.rows]]]
        place, feature = self._search.match(features, view, seen, local, config.mapping.fuse_radius).unbind(dim=1)
        row, T_cw = seen.rows[place], T_cw[seen.view[place]]
        in_camera = (T_cw[:, :3, :3] @ local.points[row, :, None])[..., 0] + T_cw[:, :3, 3]
        measured = measurements(features[feature], config.tracking, config.features)
        fits = chi_square(in_camera, reprojection(in_camera, measured, self._camera)) <= measured.limit
        found = torch.full_like(view, -1)
        found[feature[fits]] = local.ids[row[fits]]
        return found.split(counts)


def _joined(keyframes: Sequence[Keyframe]) -> Features:
    """Features of all keyframes, one keyframe's after another's."""
    of_each = [vars(keyframe.features) for keyframe in keyframes]
    return Features(**{name: torch.cat([columns[name] for columns in of_each]) for name in of_each[0]})
