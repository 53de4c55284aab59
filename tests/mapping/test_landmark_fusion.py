"""Landmark fusion: duplicate landmarks of one point are merged, landmarks of different points are not."""

from __future__ import annotations

import torch
from helpers.sparse_maps import CAMERA, EYE, features, make_map, uniform
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.mapping.covisibility import count_shared_landmarks
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.landmark_fusion import LandmarkFusion
from v3d_torch.mapping.landmark_ids import merge_landmarks
from v3d_torch.mapping.sparse_map import SparseMap

POINTS = 120
SHARED = 10
"""Number of points whose landmarks are matched in all keyframes from the start."""
OFFSET = torch.tensor([50.0, 0.0], dtype=torch.float64)


class Room:
    """Adjacent keyframes that observe the same points and have created their own landmarks for most of them."""

    def __init__(self, keyframes: int = 3) -> None:
        first = features(POINTS, seed=3)
        self.points = CAMERA.back_project(first.uv, 2 + uniform(POINTS, seed=4))
        self.descriptors = first.descriptors
        self.map = make_map()
        self.feature_points: list[Tensor] = []  # for each keyframe, the index of the point of each feature
        for k in range(keyframes):
            self.insert(se3_exp(torch.tensor([-0.05 * k, 0, 0, 0, -0.01 * k, 0], dtype=torch.float64)))

    def observe(self, T_cw: Tensor) -> tuple[Features, Tensor]:
        """Features of a camera, and the index of the point of each feature."""
        in_camera = self.points @ T_cw[:3, :3].T + T_cw[:3, 3]
        uv = CAMERA.project(in_camera)
        points = torch.nonzero(((uv > 0) & (uv < torch.tensor([639, 479]))).all(dim=1))[:, 0]
        octave = torch.zeros(len(points), dtype=torch.int64)
        uv = uv[points]
        return Features(uv, uv.long(), in_camera[points, 2], octave, self.descriptors[points]), points

    def insert(self, T_cw: Tensor) -> Keyframe:
        observed, points = self.observe(T_cw)
        landmarks = torch.full((len(points),), -1)
        if self.map.keyframes:
            first = self.map.keyframes[0].landmarks[self.feature_points[0].argsort()]  # it observes all points
            landmarks = torch.where(points < SHARED, first[points], -1)
        self.feature_points.append(points)
        index = len(self.map.keyframes)
        return self.map.insert_keyframe(index, index / 30, T_cw, observed, landmarks)

    def landmarks_of(self, point: int) -> set[int]:
        """Ids of the landmarks of a point in all keyframes."""
        keyframes = zip(self.map.keyframes, self.feature_points, strict=True)
        return {int(landmark) for keyframe, points in keyframes for landmark in keyframe.landmarks[points == point]}

    def fuse(self, *overrides: str) -> None:
        """Fuse the landmarks of the newest keyframe."""
        LandmarkFusion(load_config(overrides=overrides), CAMERA)(self.map, self.map.keyframes[-1])
        assert_consistent(self.map)


def assert_consistent(sparse_map: SparseMap) -> None:
    """Check that the table of observations agrees with the landmark ids of the keyframes."""
    table = sparse_map.observations
    rows = torch.nonzero(table["valid"])[:, 0]
    in_table = sorted(zip(*(table[name][rows].tolist() for name in ("keyframe", "feature", "landmark")), strict=True))
    in_keyframes = [
        (keyframe.index, feature, int(keyframe.landmarks[feature]))
        for keyframe in sparse_map.keyframes
        for feature in torch.nonzero(keyframe.landmarks >= 0)[:, 0].tolist()
    ]
    assert in_table == in_keyframes
    assert all(
        len(keyframe.observed_landmarks.unique()) == len(keyframe.observed_landmarks)
        for keyframe in sparse_map.keyframes
    )
    assert sparse_map.landmarks["active"][table["landmark"][rows]].all()


def test_landmarks_of_one_point_are_merged_into_the_oldest() -> None:
    room = Room()
    doubled = [point for point in range(SHARED, POINTS) if len(room.landmarks_of(point)) == 3]
    assert len(doubled) > 90
    oldest = [min(room.landmarks_of(point)) for point in doubled]
    room.fuse()
    assert [room.landmarks_of(point) for point in doubled] == [{landmark} for landmark in oldest]
    assert count_shared_landmarks(room.map, torch.tensor(oldest)).tolist() == 3 * [len(doubled)]


def test_match_counters_of_merged_landmarks_are_added() -> None:
    room = Room(2)
    one, other = sorted(room.landmarks_of(SHARED))
    room.map.landmarks["found"][[one, other]] = torch.tensor([3, 4])
    room.map.landmarks["visible"][[one, other]] = torch.tensor([5, 7])
    room.fuse()
    assert (int(room.map.landmarks["found"][one]), int(room.map.landmarks["visible"][one])) == (7, 12)


def test_matched_feature_without_landmark_becomes_an_observation() -> None:
    room = Room(2)
    first = room.map.keyframes[0]
    points = room.feature_points[0]
    chosen = torch.nonzero((points >= SHARED) & (points % 4 == 0) & torch.isin(points, room.feature_points[1]))
    table = room.map.observations
    room.map.remove_observations(torch.nonzero((table["keyframe"] == 0) & torch.isin(table["feature"], chosen))[:, 0])
    assert (first.landmarks[chosen] == -1).all() and len(chosen) > 20
    room.fuse()
    assert (first.landmarks[chosen] >= 0).all()
    assert all(len(room.landmarks_of(int(points[feature]))) == 1 for feature in chosen)


def test_landmarks_observed_by_one_keyframe_are_not_merged() -> None:
    room = Room(2)
    points = torch.tensor([SHARED, SHARED + 1])
    # A third keyframe observes both landmarks of each point, as different features.
    pairs = [sorted(room.landmarks_of(int(point))) for point in points]
    distinct = torch.tensor([*pairs[0], *pairs[1]])
    room.map.insert_keyframe(2, 2 / 30, EYE, features(4, depth=0.0, seed=77), distinct)
    room.feature_points.append(torch.full((4,), -1))
    LandmarkFusion(Config(), CAMERA)(room.map, room.map.keyframes[1])
    assert [sorted(room.landmarks_of(int(point))) for point in points] == pairs
    assert len(room.landmarks_of(SHARED + 2)) == 1


def test_landmarks_with_other_descriptor_or_position_are_not_merged() -> None:
    room = Room(2)
    second = room.map.keyframes[1]
    displaced, other = SHARED, SHARED + 1
    landmark = second.landmarks[room.feature_points[1] == displaced]
    room.map.landmarks["point"][landmark] += torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)  # 15 pixels or more
    room.map.landmarks["descriptor"][second.landmarks[room.feature_points[1] == other]] ^= 255
    second.features.descriptors[room.feature_points[1] == other] ^= 255
    second.features.uv[room.feature_points[1] == displaced] += OFFSET
    room.fuse()
    assert len(room.landmarks_of(displaced)) == len(room.landmarks_of(other)) == 2


def test_landmarks_at_other_depth_on_the_same_ray_are_not_merged() -> None:
    room = Room(2)
    second = room.map.keyframes[1]
    landmark = second.landmarks[room.feature_points[1] == SHARED]
    first, point = room.map.keyframes[0], room.map.landmarks["point"][landmark]
    centre = -first.T_cw[:3, :3].T @ first.T_cw[:3, 3]
    room.map.landmarks["point"][landmark] = centre + 1.3 * (point - centre)  # on a ray of the first keyframe
    second.features.uv[room.feature_points[1] == SHARED] += OFFSET
    room.fuse()
    assert len(room.landmarks_of(SHARED)) == 2


def test_fusion_without_neighbours_changes_nothing() -> None:
    room = Room(3)
    before = [keyframe.landmarks.clone() for keyframe in room.map.keyframes]
    room.fuse("mapping.fusion_keyframes=0")
    assert all(torch.equal(old, keyframe.landmarks) for old, keyframe in zip(before, room.map.keyframes, strict=True))


@settings(max_examples=25)
@given(st.lists(st.lists(st.integers(-1, 30), min_size=8, max_size=8), min_size=1, max_size=5), st.integers(0, 2**16))
def test_table_and_keyframes_agree_after_any_fusion(matches: list[list[int]], seed: int) -> None:
    sparse_map = make_map()
    for k in range(4):
        sparse_map.insert_keyframe(k, k / 30, EYE, features(8, seed=seed + k), torch.full((8,), -1))
    for k, ids in enumerate(matches):
        # Projection matching returns active landmarks, each at most once.
        matched = torch.tensor(ids)
        repeated = torch.tensor([landmark in ids[:i] for i, landmark in enumerate(ids)])
        matched[repeated | ~sparse_map.landmarks["active"][matched.clamp(min=0)]] = -1
        sparse_map.fuse_landmarks(sparse_map.keyframes[k % 4], matched)
        assert_consistent(sparse_map)


def test_landmarks_are_merged_although_one_keyframe_had_a_wrong_observation_of_both() -> None:
    sparse_map = make_map()
    sparse_map.insert_keyframe(0, 0.0, EYE, features(2), torch.tensor([-1, -1]))
    sparse_map.insert_keyframe(1, 0.1, EYE, features(1), torch.tensor([1]))
    sparse_map.remove_observations(torch.tensor([1]))  # of landmark 1, by keyframe 0
    merge_landmarks(sparse_map, torch.tensor([0]), torch.tensor([1]))
    assert sparse_map.landmarks["active"].tolist() == [True, False]
    assert [keyframe.landmarks.tolist() for keyframe in sparse_map.keyframes] == [[0, -1], [0]]
