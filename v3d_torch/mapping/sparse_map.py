"""Sparse map: keyframes, landmarks and observations (ORB-SLAM2, Mur-Artal and Tardos, T-RO 2017, Sec. III)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import Config, FeaturesConfig, MappingConfig
from v3d_torch.features.features import Features
from v3d_torch.features.projection_matcher import LocalMap
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, orthonormalise
from v3d_torch.mapping import landmark_ids
from v3d_torch.mapping.covisibility import covisible_keyframes, landmarks_ever_observed
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.landmark_creation import create_landmarks, landmark_points, select_new_landmarks
from v3d_torch.mapping.landmark_motion import move_landmarks
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.membership import contains
from v3d_torch.odometry.rolling_shutter import Readout


class SparseMap(MapTables):
    """Keyframes and landmarks with their observations.

    Args:
        config: Creation of landmarks, and whether the map can change.
        features_config: Scale pyramid of the features.
        camera: Intrinsics, for the back-projection of features to landmarks.

    Attributes:
        config: Creation of landmarks, and whether the map can change.
        features_config: Scale pyramid of the features.
        camera: Intrinsics.
    """

    def __init__(self, config: MappingConfig, features_config: FeaturesConfig, camera: PinholeCamera) -> None:
        super().__init__()
        self.config = config
        self.features_config = features_config
        self.camera = camera

    @classmethod
    def empty(cls, config: Config, camera: PinholeCamera) -> SparseMap:
        """Create an empty map with the readout of the camera, or of the configuration if the camera states none.

        Args:
            config: Configuration of the whole system.
            camera: Camera of the frames.
        """
        sparse_map = cls(config.mapping, config.features, camera)
        sparse_map.readout = Readout.from_camera(camera, config.rolling_shutter)
        return sparse_map

    def insert_keyframe(
        self, frame: int, stamp: float, T_cw: Tensor, features: Features, landmarks: Tensor
    ) -> Keyframe:
        """Insert a keyframe and create landmarks from its unmatched features with depth.

        Args:
            frame: Index of the frame.
            stamp: Timestamp, seconds.
            T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
            features: Features on static pixels.
            landmarks: Id of the landmark matched to each feature, -1 for none, int64, shape :math:`(N,)`.

        Returns:
            The new keyframe.
        """
        index = len(self.keyframes)
        landmarks = landmarks.clone()
        new = select_new_landmarks(features, landmarks, self.config.landmarks_per_keyframe, self.features_config.cell)
        landmarks[new] = create_landmarks(self.landmarks, index, T_cw, features[new], self.camera, self.features_config)
        keyframe = Keyframe(index, frame, stamp, T_cw, features, torch.full_like(landmarks, -1))
        self.keyframes.append(keyframe)
        self._add_observations(keyframe, torch.nonzero(landmarks >= 0)[:, 0], landmarks)
        return keyframe

    def count_matches(self, found: Tensor, visible: Tensor) -> None:
        """Update the match counters of the landmarks after a frame was tracked.

        The counters stay unchanged if the map is used for localisation only.

        Args:
            found: Ids of the landmarks that the frame matched, int64, shape :math:`(F,)`.
            visible: Ids of the landmarks that the frame should have matched, int64, shape :math:`(V,)`.
        """
        if self.config.enabled:
            self.landmarks["found"][found] += 1
            self.landmarks["visible"][visible] += 1

    def local_map(self, landmarks: Tensor, count: int) -> LocalMap:
        """Return the local map: all landmarks that the most covisible keyframes observe or observed.

        Args:
            landmarks: Ids of the landmarks that the previous frame observed, int64, shape :math:`(L,)`.
            count: Maximum number of keyframes.
        """
        return self.select_landmarks(landmarks_ever_observed(self, covisible_keyframes(self, landmarks, count)))

    def select_landmarks(self, landmarks: Tensor) -> LocalMap:
        """Return the active landmarks among the given ones as a local map.

        Args:
            landmarks: Ids, ascending, int64, shape :math:`(L,)`.
        """
        ids = landmarks[self.landmarks["active"][landmarks]]
        # index_select is faster than indexing here.
        point, direction, reference_distance, descriptor = (
            self.landmarks[name].index_select(0, ids)
            for name in ("point", "direction", "reference_distance", "descriptor")
        )
        return LocalMap(ids, point, direction, reference_distance, descriptor)

    def landmark_positions(self, landmarks: Tensor) -> tuple[Tensor, Tensor]:
        """World positions of the landmarks matched to features.

        Args:
            landmarks: Id of the landmark matched to each feature, -1 for none, int64, shape :math:`(N,)`.

        Returns:
            Indices of the features with an active landmark, int64, shape :math:`(L,)`, and the positions of the
            landmarks, world frame, metres, float64, shape :math:`(L, 3)`.
        """
        matched = torch.nonzero(landmarks >= 0)[:, 0]
        matched = matched[self.landmarks["active"][landmarks[matched]]]
        return matched, self.landmarks["point"].index_select(0, landmarks[matched])

    def move_keyframes(self, T_cw: Tensor) -> None:
        """Set the poses of all keyframes, and move each landmark with the keyframe that created it.

        A culled keyframe moves rigidly with its reference keyframe.

        Args:
            T_cw: World-to-camera poses, float64, shape :math:`(K, 4, 4)`; ignored for culled keyframes.
        """
        previous, references = self.T_cw, self.references
        culled = references != torch.arange(len(references))
        T_cw = T_cw.clone()
        T_cw[culled] = orthonormalise(
            previous[culled] @ invert(previous[references[culled]]) @ T_cw[references[culled]]
        )
        table = self.landmarks
        moved = move_landmarks(invert(T_cw) @ previous, table["keyframe"], table["point"], table["direction"])
        for column, values in zip(("point", "direction"), moved, strict=True):
            table[column].numpy()[:] = values.numpy()  # the columns can be tensors of inference mode
        for keyframe, pose in zip(self.keyframes, T_cw, strict=True):
            keyframe.T_cw = pose

    def update_features(self, keyframe: Keyframe, features: Features, T_cw: Tensor | None = None) -> None:
        """Replace the features of a keyframe by the same features with corrected pixels and depth.

        The landmarks that only this keyframe observes are computed again from its features in two cases: if ``T_cw`` is
        given, or if the keyframe created all landmarks that it observes, so that its pose does not depend on features.
        Otherwise the next bundle adjustment corrects them together with the pose.

        Args:
            keyframe: Keyframe of this map.
            features: The corrected features, in the same order.
            T_cw: World-to-camera pose, refined with these features, float64, shape :math:`(4, 4)`; None to keep the
                pose.
        """
        keyframe.features = features
        valid = self.observations["valid"]
        rows = torch.nonzero((self.observations["keyframe"] == keyframe.index) & valid)[:, 0]
        feature, landmark = (self.observations[name][rows] for name in ("feature", "landmark"))
        for name in ("uv", "inverse_depth", "readout_jacobian"):
            self.observations[name][rows] = getattr(features, name)[feature]
        created = self.landmarks["keyframe"][landmark] == keyframe.index
        if T_cw is not None:
            keyframe.T_cw = T_cw
        elif not bool(created.all()):
            return
        is_own = created & (torch.bincount(self.observations["landmark"][valid])[landmark] == 1)
        moved = is_own & self.landmarks["active"][landmark] & (features.depth[feature] > 0)
        points = landmark_points(invert(keyframe.T_cw), features[feature[moved]], self.camera)
        self.landmarks["point"][landmark[moved]] = points

    def set_readout(self, readout: Readout) -> None:
        """Set the readout and shift all stored features accordingly.

        Args:
            readout: New estimate of the camera's readout.
        """
        change = readout.seconds - self.readout.seconds
        self.readout = readout
        self.observations["uv"].add_(self.observations["readout_jacobian"], alpha=change)
        for keyframe in self.active_keyframes:
            features = keyframe.features
            keyframe.features = replace(features, uv=features.uv + change * features.readout_jacobian)

    def fuse_landmarks(self, keyframe: Keyframe, landmarks: Tensor) -> None:
        """Fuse landmarks of a keyframe with landmarks of the map that were matched to the same features.

        A feature without a landmark becomes an observation of the matched landmark. If the feature already has
        another landmark, the two landmarks are merged into the older one, unless one keyframe observes both. If the
        older one is culled, the merged landmark is culled, too: frames did not match this point well.

        Args:
            keyframe: Keyframe whose features were matched.
            landmarks: Id of the matched landmark of each feature, -1 for none, int64, shape :math:`(N,)`.
        """
        # NumPy is faster than torch for these small arrays.
        own, matched = keyframe.landmarks.numpy(), landmarks.numpy()
        features = np.flatnonzero(matched >= 0)
        features = features[~contains(own, matched[features], len(self.landmarks))]
        is_duplicate = own[features] >= 0
        duplicates = features[is_duplicate]
        own, other = own[duplicates], matched[duplicates]
        self._add_observations(keyframe, torch.from_numpy(features[~is_duplicate]), landmarks)
        pairs = np.minimum(own, other), np.maximum(own, other)
        landmark_ids.merge_landmarks(self, *map(torch.from_numpy, pairs))

    def remove_observations(self, rows: Tensor) -> None:
        """Remove observations that a bundle adjustment found to be outliers.

        Args:
            rows: Rows of the table of observations, int64, shape :math:`(O,)`.
        """
        self.observations["valid"][rows] = False
        keyframes, features = self.observations["keyframe"][rows], self.observations["feature"][rows]
        for index in keyframes.unique().tolist():
            self.keyframes[index].landmarks[features[keyframes == index]] = -1

    def _add_observations(self, keyframe: Keyframe, indices: Tensor, landmarks: Tensor) -> None:
        """Add observations by some features of a keyframe, given the landmark ids of all its features."""
        if len(indices) == 0:
            return
        landmarks = landmarks[indices]
        keyframe.landmarks[indices] = landmarks
        # index_select is faster than indexing here.
        names = "uv", "readout_jacobian", "inverse_depth", "octave", "sigma_ratio"
        columns = {name: getattr(keyframe.features, name).index_select(0, indices) for name in names}
        self.observations.append(
            keyframe=torch.full_like(indices, keyframe.index),
            landmark=landmarks,
            feature=indices,
            **columns,
            valid=torch.ones_like(indices, dtype=torch.bool),
        )
