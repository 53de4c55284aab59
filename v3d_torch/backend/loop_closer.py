"""Loop closing: recognise a place, verify it geometrically, correct pose graph and map (paper, Sec. III-E)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase
from v3d_torch.backend.pose_graph import optimise_pose_graph
from v3d_torch.config import LoopConfig
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert
from v3d_torch.mapping.covisibility import count_shared_landmarks, covisibility_edges
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.motion_estimator import MotionEstimator, propagate_landmarks
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.tracking.map_tracker import MapTracker, MapTracking

_MIN_SHARED_LANDMARKS = 30
"""Minimum number of shared landmarks of two keyframes with an edge in the pose graph. ORB-SLAM2 requires 100 for its
essential graph, with 2000 features per image; here images have fewer features."""


@dataclass(frozen=True)
class PlaceMatch:
    """A place in the map that was recognised in an image and verified.

    Attributes:
        keyframe: Keyframe that observed the place before.
        tracking: Pose and landmarks of the image in the map around that keyframe.
    """

    keyframe: Keyframe
    tracking: MapTracking


@dataclass(frozen=True)
class LoopCorrection:
    """A detected loop and the keyframe poses that close it.

    Attributes:
        place: Place at which the loop begins.
        loop: Relative pose between the keyframe of that place and the keyframe at which the loop ends.
        T_cw: World-to-camera poses of all keyframes, float64, shape :math:`(K, 4, 4)`; the poses of culled keyframes
            are meaningless.
    """

    place: PlaceMatch
    loop: Loop
    T_cw: Tensor


class LoopCloser(StatefulComponent):
    """Recognises places in the map: to relocalise a lost camera, and to detect and correct loops.

    Its state does not contain the database of keyframes: after `load_state_dict`, call `rebuild_database`.

    Args:
        config: Configuration of loop closing.
        estimate_motion: Estimator of the motion between two images from their features.
        track_map: Tracker that refines a pose in a local map.
        local_keyframes: Number of keyframes that form a local map.

    Attributes:
        loop_count: Number of loops that were corrected.
    """

    _STATE = ("loop_count",)

    def __init__(
        self, config: LoopConfig, estimate_motion: MotionEstimator, track_map: MapTracker, local_keyframes: int
    ) -> None:
        self._config = config
        self._estimate_motion = estimate_motion
        self._track_map = track_map
        self._local_keyframes = local_keyframes
        self._database = KeyframeDatabase()
        self.loop_count = 0

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Add a keyframe to the database of place recognition."""
        self._database.add(keyframe.index, keyframe.features.descriptors)

    def remove_keyframes(self, keyframes: Iterable[int]) -> None:
        """Remove keyframes, given by their indices, from the database of place recognition."""
        self._database.remove(keyframes)

    def rebuild_database(self, keyframes: Iterable[Keyframe]) -> None:
        """Replace the database of place recognition by the given keyframes.

        Args:
            keyframes: Active keyframes of the map, without a keyframe that is pending in the back end.
        """
        self._database = KeyframeDatabase()
        for keyframe in keyframes:
            self.add_keyframe(keyframe)
        self._database.index_keyframes()

    def relocalise(self, features: Features, sparse_map: SparseMap) -> PlaceMatch | None:
        """Find the place in the map at which an image was taken.

        Args:
            features: Features of the image.
            sparse_map: Map to search.

        Returns:
            The first candidate that passes verification: a relative motion to its keyframe is found, and enough
            landmarks around the keyframe match. None if no candidate passes.
        """
        return next(self._verified_places(features, sparse_map, exclude=()), None)

    def detect_loop(self, keyframe: Keyframe, sparse_map: SparseMap, T_cw: Tensor) -> LoopCorrection | None:
        """Detect a loop that ends at a keyframe and optimise the pose graph with it; the map does not change.

        Args:
            keyframe: Newest keyframe.
            sparse_map: Map of the keyframe.
            T_cw: World-to-camera poses of all keyframes, from which the edges of the pose graph other than loops are
                computed, float64, shape :math:`(K, 4, 4)`; those of culled keyframes are ignored.

        Returns:
            The loop and corrected poses; None if there is no loop or loop closing is disabled.
        """
        self._database.index_keyframes()  # here, because tracking does not wait for it
        place = self._detect_revisit(keyframe, sparse_map) if self._config.enabled else None
        if place is None:
            return None
        # Old keyframe i, new keyframe j: T_ij is the pose of camera j in camera i, both in the map around keyframe i.
        T_ij = place.keyframe.T_cw @ invert(place.tracking.T_cw)
        loop = Loop(place.keyframe.index, keyframe.index, T_ij)
        return LoopCorrection(place, loop, self._optimise_poses(sparse_map, T_cw, [*sparse_map.loops, loop]))

    def correct_loop(self, correction: LoopCorrection, sparse_map: SparseMap) -> Tensor:
        """Correct keyframes and landmarks of the map in place, and join parts and landmarks on both sides of the loop.

        Returns:
            Transform ``T_new_old`` from the old to the corrected world frame at the keyframe at which the loop ends,
            float64, shape :math:`(4, 4)`.
        """
        place, keyframe = correction.place, sparse_map.keyframes[correction.loop.j]
        previous_T_cw = keyframe.T_cw
        sparse_map.loops.append(correction.loop)
        self.loop_count += 1
        sparse_map.move_keyframes(correction.T_cw)
        sparse_map.fuse_landmarks(keyframe, place.tracking.landmarks)
        sparse_map.join_parts(place.keyframe.part, keyframe.part)
        return invert(keyframe.T_cw) @ previous_T_cw

    def _verified_places(
        self, features: Features, sparse_map: SparseMap, exclude: Iterable[int]
    ) -> Iterator[PlaceMatch]:
        """Verify the candidates one after another, best first, and yield those that pass; see `relocalise`."""
        for index, _ in self._database.query(features.descriptors, self._config.candidates, exclude):
            keyframe = sparse_map.keyframes[index]
            motion = self._estimate_motion(keyframe.features, features)
            if motion is None:
                continue
            local = sparse_map.local_map(keyframe.observed_landmarks, self._local_keyframes)
            propagated = propagate_landmarks(motion.inlier_matches, keyframe.landmarks, len(features))
            tracking = self._track_map(features, motion.T_ba @ keyframe.T_cw, local, propagated)
            if tracking is not None and tracking.landmark_count >= self._config.min_inliers:
                yield PlaceMatch(keyframe, tracking)

    def _detect_revisit(self, keyframe: Keyframe, sparse_map: SparseMap) -> PlaceMatch | None:
        """Find a place whose keyframe is neither recent nor covisible; None soon after another loop."""
        if sparse_map.loops and keyframe.index - sparse_map.loops[-1].j < self._config.min_keyframe_gap:
            return None
        covisible = count_shared_landmarks(sparse_map, keyframe.observed_landmarks).nonzero()[:, 0].tolist()
        recent = range(keyframe.index - self._config.min_keyframe_gap, keyframe.index + 1)
        for place in self._verified_places(keyframe.features, sparse_map, {*covisible, *recent}):
            if place.tracking.landmark_count >= self._config.min_inlier_ratio * len(place.tracking.visible):
                return place
        return None

    def _optimise_poses(self, sparse_map: SparseMap, T_cw: Tensor, loops: Sequence[Loop]) -> Tensor:
        """Optimise the poses of the active keyframes by the pose graph of covisibility and loops, shape (K, 4, 4)."""
        covisible = covisibility_edges(sparse_map, _MIN_SHARED_LANDMARKS)
        T_covisible = T_cw[covisible[:, 0]] @ invert(T_cw[covisible[:, 1]])
        reference = sparse_map.references
        i, j = torch.tensor([[loop.i, loop.j] for loop in loops]).unbind(dim=1)
        # Transfer each loop to active keyframes: a culled keyframe keeps its pose relative to its reference keyframe.
        # The adjustment in T_cw did not move culled keyframes, so their relative poses are those of the map.
        old = sparse_map.T_cw
        T_reference_i, T_j_reference = old[reference[i]] @ invert(old[i]), old[j] @ invert(old[reference[j]])
        T_loop = T_reference_i @ torch.stack([loop.T_ij for loop in loops]) @ T_j_reference
        active, node = reference.unique(return_inverse=True)
        loop_edges = torch.stack([node[i], node[j]], dim=1)
        is_edge = loop_edges[:, 0] != loop_edges[:, 1]  # both ends of a loop can have the same reference keyframe
        edges = torch.cat([node[covisible], loop_edges[is_edge]])
        T_ij = torch.cat([T_covisible, T_loop[is_edge]])
        optimised = optimise_pose_graph(invert(T_cw[active]), edges, T_ij)
        return T_cw.index_copy(0, active, invert(optimised.T_wc))
