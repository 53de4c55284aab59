"""The map: keyframes, landmarks, and who sees whom (ORB-SLAM2, Sec. III; Mur-Artal and Tardos, T-RO 2017)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, MappingConfig
from v3d_torch.features.features import Features, select_evenly
from v3d_torch.features.projection_matcher import LocalMap
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, orthonormalise
from v3d_torch.mapping.keyframe import Keyframe, Loop, stack_poses
from v3d_torch.mapping.tensor_table import TensorTable
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout

_LANDMARKS = 2
"""For each observation: only of more it is worth to look for those that can go."""


class SparseMap:
    """Keyframes and landmarks with their observations, as tables of tensors.

    Args:
        config: which landmarks are made.
        features: scale pyramid of the features.
        camera: lifts features with depth to landmarks.
    """

    def __init__(self, config: MappingConfig, features: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self.features = features
        self.camera = camera
        self.keyframes: list[Keyframe] = []
        self.loops: list[Loop] = []
        self.readout = GLOBAL_SHUTTER
        self.landmarks = TensorTable(
            point=((3,), torch.float64),
            direction=((3,), torch.float64),
            reference_distance=((), torch.float64),
            descriptor=((32,), torch.uint8),
            keyframe=((), torch.int64),  # that made it
            found=((), torch.int64),  # frames that matched it
            visible=((), torch.int64),  # frames that should have
            alive=((), torch.bool),
        )
        self.observations = TensorTable(
            keyframe=((), torch.int64),
            landmark=((), torch.int64),
            feature=((), torch.int64),  # of the keyframe
            uv=((2,), torch.float64),
            readout_jacobian=((2,), torch.float64),  # of uv, with the readout
            inverse_depth=((), torch.float64),
            octave=((), torch.int64),
            valid=((), torch.bool),  # until a bundle adjustment finds that it does not fit
        )

    @property
    def active_keyframes(self) -> list[Keyframe]:
        """The keyframes that are not retired."""
        return [keyframe for keyframe in self.keyframes if not keyframe.is_culled]

    @property
    def T_cw(self) -> Tensor:
        """World to camera of all keyframes, retired ones too, float64, shape :math:`(K, 4, 4)`; K may be 0."""
        return stack_poses(self.keyframes)

    @property
    def references(self) -> Tensor:
        """Index of the keyframe that each goes along with, its own unless it is retired, int64, shape :math:`(K,)`."""
        return torch.tensor([keyframe.reference for keyframe in self.keyframes], dtype=torch.int64)

    def insert_keyframe(
        self, frame: int, stamp: float, T_cw: Tensor, features: Features, landmarks: Tensor
    ) -> Keyframe:
        """Make a keyframe; features with depth that match no landmark become landmarks.

        Args:
            frame: index of the frame.
            stamp: seconds.
            T_cw: world-to-camera pose.
            features: on pixels that stand still.
            landmarks: id behind each feature, -1 for none, int64, shape :math:`(N,)`.
        """
        index = len(self.keyframes)
        landmarks = landmarks.clone()
        fresh = self._fresh(features, landmarks)
        landmarks[fresh] = self._create(index, T_cw, features[fresh])
        keyframe = Keyframe(index, frame, stamp, T_cw, features, torch.full_like(landmarks, -1))
        self.keyframes.append(keyframe)
        self._observe(keyframe, torch.nonzero(landmarks >= 0)[:, 0], landmarks)
        return keyframe

    def count_matches(self, found: Tensor, visible: Tensor) -> None:
        """Count in how many frames each landmark was found, and in how many it should have been visible.

        A map that is used for localisation only keeps its counts.

        Args:
            found: ids of the landmarks that a frame found, int64, shape :math:`(F,)`.
            visible: ids of those that it should have seen, int64, shape :math:`(V,)`.
        """
        if self._config.enabled:
            self.landmarks["found"][found] += 1
            self.landmarks["visible"][visible] += 1

    def covisible_keyframes(self, landmarks: Tensor, count: int) -> Tensor:
        """The keyframes that see most of the given landmarks, best first.

        Args:
            landmarks: ids, int64, shape :math:`(L,)`.
            count: most keyframes.

        Returns:
            Indices of keyframes that see at least one, int64, shape :math:`(<= count,)`.
        """
        shared = self.count_shared(landmarks)
        newest_first = shared * len(shared) + torch.arange(len(shared))  # of those that share as many
        order = torch.argsort(newest_first, descending=True)[:count]
        return order[shared[order] > 0]

    def count_shared(self, landmarks: Tensor) -> Tensor:
        """How many of the given landmarks each keyframe sees, int64, shape :math:`(K,)`."""
        wanted = torch.zeros(len(self.landmarks), dtype=torch.bool)
        wanted[landmarks] = True
        seeing = self.observations["keyframe"][self.observations["valid"] & wanted[self.observations["landmark"]]]
        return torch.bincount(seeing, minlength=len(self.keyframes))

    def is_among(self, landmarks: Tensor, some: Tensor) -> Tensor:
        """Which landmarks are among some, bool: by a table of all, as `torch.isin` would sort. -1 stands for none."""
        table = torch.zeros(len(self.landmarks) + 1, dtype=torch.bool)
        return table.index_fill_(0, some, True)[landmarks]

    def local_map(self, landmarks: Tensor, count: int) -> LocalMap:
        """What a frame may see that saw ``landmarks`` just now: all that its ``count`` best keyframes see."""
        chosen = torch.zeros(len(self.keyframes), dtype=torch.bool)
        chosen[self.covisible_keyframes(landmarks, count)] = True
        seen = torch.zeros(len(self.landmarks), dtype=torch.bool)
        seen[self.observations["landmark"][chosen[self.observations["keyframe"]]]] = True
        return self.select_landmarks(torch.nonzero(seen)[:, 0])

    def landmark_positions(self, landmarks: Tensor) -> tuple[Tensor, Tensor]:
        """Where landmarks are that features show.

        Args:
            landmarks: id of the landmark behind each feature, -1 for none, int64, shape :math:`(N,)`.

        Returns:
            Indices of the features whose landmark still lives, int64, shape :math:`(L,)`, and its place in the world,
            metres, float64, shape :math:`(L, 3)`.
        """
        found = torch.nonzero(landmarks >= 0)[:, 0]
        found = found[self.landmarks["alive"][landmarks[found]]]
        return found, self.landmarks["point"].index_select(0, landmarks[found])

    def select_landmarks(self, landmarks: Tensor) -> LocalMap:
        """Landmarks as a frame looks for them, those that are still alive.

        Args:
            landmarks: ids, ascending, int64, shape :math:`(L,)`.
        """
        ids = landmarks[self.landmarks["alive"][landmarks]]
        # Rows by index_select: plain indexing takes up to nine times as long for them.
        point, direction, reference_distance, descriptor = (
            self.landmarks[name].index_select(0, ids)
            for name in ("point", "direction", "reference_distance", "descriptor")
        )
        return LocalMap(ids, point, direction, reference_distance, descriptor)

    def covisibility_edges(self, least: int) -> Tensor:
        """Pairs (i, j), i < j, of keyframes that share at least so many landmarks, and consecutive ones of those kept.

        Not those between which the camera was lost: what joins them is a guess.

        Returns:
            int64, shape :math:`(E, 2)`, sorted.
        """
        valid = self.observations["valid"]
        rows, columns = self.observations["keyframe"][valid].numpy(), self.observations["landmark"][valid].numpy()
        shape = (len(self.keyframes), len(self.landmarks))
        seen = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)
        shared = scipy.sparse.triu(seen @ seen.T, k=1).tocoo()
        enough = shared.data >= least
        pairs = torch.from_numpy(np.stack([shared.row[enough], shared.col[enough]], axis=1).astype(np.int64))
        kept = self.active_keyframes
        index = torch.tensor([keyframe.index for keyframe in kept], dtype=torch.int64)
        disconnected = torch.tensor([keyframe.disconnected for keyframe in kept], dtype=torch.bool)
        joined = disconnected[:-1] == disconnected[1:]
        return torch.cat([pairs, torch.stack([index[:-1][joined], index[1:][joined]], dim=1)]).unique(dim=0)

    def move_keyframes(self, T_cw: Tensor) -> None:
        """Put keyframes at new poses; retired ones go along, and each landmark with the keyframe that made it.

        Args:
            T_cw: world to camera, shape :math:`(K, 4, 4)`; what it says of retired ones does not count.
        """
        before, reference = self.T_cw, self.references
        along = reference != torch.arange(len(reference))
        T_cw = T_cw.clone()
        T_cw[along] = orthonormalise(before[along] @ invert(before[reference[along]]) @ T_cw[reference[along]])
        T_new_old = (invert(T_cw) @ before)[self.landmarks["keyframe"]]
        R, t = T_new_old[:, :3, :3], T_new_old[:, :3, 3]
        self.landmarks["point"][:] = (R @ self.landmarks["point"][..., None])[..., 0] + t
        self.landmarks["direction"][:] = (R @ self.landmarks["direction"][..., None])[..., 0]
        for keyframe, pose in zip(self.keyframes, T_cw, strict=True):
            keyframe.T_cw = pose

    def update_features(self, keyframe: Keyframe, features: Features) -> None:
        """Take the features of a keyframe, the same ones, for seen elsewhere."""
        keyframe.features = features
        rows = torch.nonzero(self.observations["keyframe"] == keyframe.index)[:, 0]
        for name in ("uv", "inverse_depth", "readout_jacobian"):
            self.observations[name][rows] = getattr(features, name)[self.observations["feature"][rows]]

    def set_readout(self, readout: Readout) -> None:
        """Take the camera for one that needs another time to read an image."""
        later = readout.seconds - self.readout.seconds
        self.readout = readout
        self.observations["uv"].add_(self.observations["readout_jacobian"], alpha=later)
        for keyframe in self.keyframes:
            seen = keyframe.features
            keyframe.features = replace(seen, uv=seen.uv + later * seen.readout_jacobian)

    def fuse_landmarks(self, keyframe: Keyframe, landmarks: Tensor) -> None:
        """Let features of a keyframe show landmarks that turned out to be behind them.

        A feature without a landmark becomes an observation of it. Where it has another, the two become one, unless some
        keyframe sees both, side by side.

        Args:
            keyframe: whose features were found again.
            landmarks: id of the known landmark behind each of its features, -1 for none, int64, shape :math:`(N,)`.
        """
        known = (landmarks >= 0) & ~self.is_among(landmarks, keyframe.landmark_ids)
        double = known & (keyframe.landmarks >= 0)
        self._observe(keyframe, torch.nonzero(known & ~double)[:, 0], landmarks)
        one, other = keyframe.landmarks[double], landmarks[double]
        self._merge(torch.minimum(one, other), torch.maximum(one, other))

    def _observe(self, keyframe: Keyframe, features: Tensor, landmarks: Tensor) -> None:
        """Note which landmarks, given for all features of a keyframe, are behind some of them, given by indices."""
        seen = keyframe.features[features]
        keyframe.landmarks[features] = landmarks[features]
        self.observations.append(
            keyframe=torch.full_like(features, keyframe.index),
            landmark=landmarks[features],
            feature=features,
            uv=seen.uv,
            readout_jacobian=seen.readout_jacobian,
            inverse_depth=seen.inverse_depth,
            octave=seen.octave,
            valid=torch.ones_like(features, dtype=torch.bool),
        )

    def _merge(self, kept: Tensor, gone: Tensor) -> None:
        """Let landmarks become others that they turned out to be; the ids are all different, shape (L,) each."""
        becomes = torch.arange(len(self.landmarks))
        becomes[gone] = kept
        touched = torch.zeros_like(becomes, dtype=torch.bool)
        touched[kept] = touched[gone] = True
        rows = torch.nonzero(self.observations["valid"] & touched[self.observations["landmark"]])[:, 0]
        keyframe, landmark = self.observations["keyframe"][rows], self.observations["landmark"][rows]
        places, times = (keyframe * len(becomes) + becomes[landmark]).unique(return_counts=True)
        side_by_side = self.is_among(kept, places[times > 1] % len(becomes))
        becomes[gone[side_by_side]] = gone[side_by_side]
        kept, gone = kept[~side_by_side], gone[~side_by_side]

        moves = becomes[landmark] != landmark
        rows, keyframe, landmark = rows[moves], keyframe[moves], becomes[landmark[moves]]
        self.observations["landmark"][rows] = landmark
        feature = self.observations["feature"][rows]
        for index in keyframe.unique().tolist():
            own = keyframe == index
            self.keyframes[index].landmarks[feature[own]] = landmark[own]
        for counted in ("found", "visible"):
            self.landmarks[counted][kept] += self.landmarks[counted][gone]
        self.landmarks["alive"][gone] = False

    def remove_observations(self, rows: Tensor) -> None:
        """Take back observations that do not fit, given by their rows in the table."""
        self.observations["valid"][rows] = False
        owners, features = self.observations["keyframe"][rows], self.observations["feature"][rows]
        for index in owners.unique().tolist():
            self.keyframes[index].landmarks[features[owners == index]] = -1

    def cull_keyframes(self, references: Mapping[int, int]) -> None:
        """Let the map do without some keyframes: what they saw is forgotten, their poses go along with others'.

        Args:
            references: index of each, and of the keyframe kept that it goes along with from now on.
        """
        for keyframe in self.keyframes:
            keyframe.reference = references.get(keyframe.reference, keyframe.reference)
        table, gone, nothing = self.observations, torch.tensor(list(references)), torch.zeros(0, dtype=torch.int64)
        for index in references:
            keyframe = self.keyframes[index]
            keyframe.features, keyframe.landmarks = keyframe.features[nothing], nothing
        table.keep_rows(table["valid"] & ~torch.isin(table["keyframe"], gone))
        seen = torch.bincount(table["landmark"], minlength=len(self.landmarks)) > 0
        self.landmarks["alive"][~seen] = False

    def cull_landmarks(self) -> None:
        """Forget landmarks that few of the frames found that should have, and those that no second keyframe saw."""
        age = len(self.keyframes) - 1 - self.landmarks["keyframe"]
        seen_by = torch.bincount(
            self.observations["landmark"][self.observations["valid"]], minlength=len(self.landmarks)
        )
        elusive = self.landmarks["found"] < 0.25 * self.landmarks["visible"]  # ORB-SLAM2's rule
        lonely = (age == 3) & (seen_by < 2)
        self.landmarks["alive"][(elusive & (age > 0)) | lonely] = False

    def compact(self, held: Iterable[Tensor]) -> None:
        """Drop landmarks that are dead and that nobody refers to, once they are most.

        So what a map takes, in memory and in time, goes by what it holds, not by what it ever held. The others get new
        ids in the order of the old ones: nothing else changes.

        Args:
            held: ids outside the map, -1 for none, int64; they are changed in place.
        """
        if len(self.landmarks) <= _LANDMARKS * len(self.observations):
            return
        tensors = [self.observations["landmark"], *(keyframe.landmarks for keyframe in self.keyframes), *held]
        referring = {tensor.data_ptr(): tensor for tensor in tensors if len(tensor)}.values()  # some share theirs
        needed = self.landmarks["alive"].clone()
        for ids in referring:
            needed[ids[ids >= 0]] = True
        self.landmarks.keep_rows(needed)
        becomes = needed.cumsum(0) - 1
        for ids in referring:
            ids.copy_(torch.where(ids >= 0, becomes[ids], -1))

    def _fresh(self, features: Features, landmarks: Tensor) -> Tensor:
        """Features that become landmarks: unmatched, with depth, as many as the map wants, spread.

        Far ones as well: their depth is worth little, and has its weight, but they tell how the camera turns. Where
        people fill the view they are often all there is.
        """
        fresh = torch.nonzero((landmarks < 0) & (features.depth > 0))[:, 0]
        wanted = max(self._config.landmarks_per_keyframe - int((landmarks >= 0).sum()), 0)
        return fresh[select_evenly(features.pixel[fresh], wanted, self.features.cell)]

    def _create(self, keyframe: int, T_cw: Tensor, features: Features) -> Tensor:
        T_wc = invert(T_cw)
        points = self.camera.back_project(features.uv, features.depth) @ T_wc[:3, :3].T + T_wc[:3, 3]
        sight = points - T_wc[:3, 3]
        distance = sight.norm(dim=1)
        ones = torch.ones(len(features), dtype=torch.int64)
        return self.landmarks.append(
            point=points,
            direction=sight / distance[:, None],
            reference_distance=distance * self.features.scale ** features.octave.to(torch.float64),
            descriptor=features.descriptors,
            keyframe=keyframe * ones,
            found=ones,
            visible=ones,
            alive=ones.to(torch.bool),
        )
