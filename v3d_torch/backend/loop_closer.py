"""Loop closing: recognise a place, verify it by geometry, correct pose graph and map (paper, Sec. III-E)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase
from v3d_torch.backend.pose_graph import optimise_pose_graph
from v3d_torch.config import LoopConfig
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.motion_estimator import MotionEstimator
from v3d_torch.tracking.map_tracker import MapTracker, Tracking


@dataclass(frozen=True)
class PlaceMatch:
    """A known place that a view was recognised to show.

    Attributes:
        keyframe: that saw it before.
        tracking: the view's pose and landmarks in the map around that keyframe.
    """

    keyframe: Keyframe
    tracking: Tracking


@dataclass(frozen=True)
class LoopCorrection:
    """A loop, and what the map has to be to close it.

    Attributes:
        place: where it begins.
        loop: the motion from there to the keyframe that it ends at.
        T_cw: world to camera of all keyframes, float64, shape :math:`(K, 4, 4)`; of retired ones it does not count.
    """

    place: PlaceMatch
    loop: Loop
    T_cw: Tensor


class LoopCloser:
    """Finds known places again, for a lost camera and for a camera that has come around.

    Args:
        config: how many candidates, how strict.
        motion: registers two views by their features.
        tracker: refines a pose in the map.
        local_keyframes: keyframes that make up a local map.
    """

    _COVISIBLE = 30  # landmarks shared by two keyframes that the pose graph ties together (ORB-SLAM2 takes 100 of 2000)

    def __init__(self, config: LoopConfig, motion: MotionEstimator, tracker: MapTracker, local_keyframes: int) -> None:
        self._config = config
        self._motion = motion
        self._tracker = tracker
        self._local_keyframes = local_keyframes
        self._index = KeyframeDatabase()
        self.loop_count = 0
        """Loops closed so far."""

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Make a keyframe a place that can be recognised."""
        self._index.add(keyframe.index, keyframe.features.descriptors)

    def relocalise(self, features: Features, sparse_map: SparseMap, exclude: Iterable[int] = ()) -> PlaceMatch | None:
        """Recognise where ``features`` were seen before, outside of the excluded keyframes.

        Returns:
            The first candidate that passes: a motion from its keyframe to the view, confirmed by the map around it.
        """
        for index, _ in self._index.query(features.descriptors, self._config.candidates, exclude):
            keyframe = sparse_map.keyframes[index]
            motion = self._motion(keyframe.features, features)
            if motion is None:
                continue
            known = keyframe.landmarks[keyframe.landmarks >= 0]
            local = sparse_map.local_map(known, self._local_keyframes)
            carried = motion.propagate_landmarks(keyframe.landmarks, len(features))
            tracking = self._tracker(features, motion.T_ba @ keyframe.T_cw, local, carried)
            if tracking is not None and tracking.count >= self._config.min_inliers:
                return PlaceMatch(keyframe, tracking)
        return None

    def remove_keyframes(self, keyframes: Iterable[int]) -> None:
        """Recognise keyframes, given by their indices, no more."""
        self._index.remove(keyframes)

    def detect_loop(self, keyframe: Keyframe, sparse_map: SparseMap, T_cw: Tensor) -> LoopCorrection | None:
        """Look for a loop that ends at ``keyframe``, and solve the pose graph with it.

        Args:
            keyframe: newest.
            sparse_map: stays as it is.
            T_cw: of its keyframes, by which they are joined beside loops, float64, shape :math:`(K, 4, 4)`.
        """
        place = self._find(keyframe, sparse_map) if self._config.enabled else None
        if place is None:
            return None
        # T_ij is the pose of camera j in camera i: old keyframe i, new keyframe j, as the place says it.
        T_ij = place.keyframe.T_cw @ invert(place.tracking.T_cw)
        loop = Loop(place.keyframe.index, keyframe.index, T_ij)
        return LoopCorrection(place, loop, self._corrected(sparse_map, T_cw, [*sparse_map.loops, loop]))

    def correct_loop(self, closure: LoopCorrection, sparse_map: SparseMap) -> Tensor:
        """Correct keyframes and landmarks, in place.

        Returns:
            The correction of the world at the keyframe, new world from old, shape :math:`(4, 4)`.
        """
        place, keyframe = closure.place, sparse_map.keyframes[closure.loop.j]
        T_cw_before = keyframe.T_cw
        sparse_map.loops.append(closure.loop)
        self.loop_count += 1
        sparse_map.move_keyframes(closure.T_cw)
        sparse_map.fuse_landmarks(keyframe, place.tracking.landmarks)
        for other in sparse_map.keyframes:
            other.disconnected &= place.keyframe.disconnected
        return invert(keyframe.T_cw) @ T_cw_before

    def _find(self, keyframe: Keyframe, sparse_map: SparseMap) -> PlaceMatch | None:
        """A place seen before that neither time nor the map connects with the keyframe; none soon after another."""
        if sparse_map.loops and keyframe.index - sparse_map.loops[-1].j < self._config.min_keyframe_gap:
            return None
        near = sparse_map.count_shared(keyframe.landmarks[keyframe.landmarks >= 0]).nonzero()[:, 0].tolist()
        recent = range(keyframe.index - self._config.min_keyframe_gap, keyframe.index + 1)
        place = self.relocalise(keyframe.features, sparse_map, {*near, *recent})
        if place is None or place.tracking.count < self._config.min_inlier_ratio * len(place.tracking.visible):
            return None
        return place

    def _corrected(self, sparse_map: SparseMap, T_cw: Tensor, loops: Sequence[Loop]) -> Tensor:
        """Poses of all keyframes that agree best with covisibility and loops, (K, 4, 4)."""
        edges = sparse_map.covisibility_edges(self._COVISIBLE)
        measured = T_cw[edges[:, 0]] @ invert(T_cw[edges[:, 1]])
        reference = sparse_map.references
        i, j = torch.tensor([[loop.i, loop.j] for loop in loops]).unbind(dim=1)
        # Between those kept: a retired keyframe stays where it is beside the one that it goes along with.
        to_i, to_j = T_cw[reference[i]] @ invert(T_cw[i]), T_cw[j] @ invert(T_cw[reference[j]])
        told = to_i @ torch.stack([loop.T_ij for loop in loops]) @ to_j
        kept, node = reference.unique(return_inverse=True)
        ends = torch.stack([node[i], node[j]], dim=1)
        apart = ends[:, 0] != ends[:, 1]
        ends, told = torch.cat([node[edges], ends[apart]]), torch.cat([measured, told[apart]])
        solved = optimise_pose_graph(invert(T_cw[kept]), ends, told)
        return T_cw.index_copy(0, kept, invert(solved.T_wc))
