"""Landmarks that several keyframes made of one point become one; others do not."""

from __future__ import annotations

import torch
from helpers.sparse_maps import CAMERA, EYE, features, numbers, sparse_map
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.landmark_fusion import LandmarkFusion
from v3d_torch.mapping.sparse_map import SparseMap

POINTS = 120
SHARED = 10  # points that all keyframes know from the start to be the same
AWAY = torch.tensor([50.0, 0.0], dtype=torch.float64)


class Room:
    """Cameras side by side that see the same points; each made its own landmarks of nearly all of them."""

    def __init__(self, keyframes: int = 3) -> None:
        look = features(POINTS, seed=3)
        self.points = CAMERA.back_project(look.uv, 2 + numbers(POINTS, seed=4))
        self.descriptors = look.descriptors
        self.map = sparse_map()
        self.seen: list[Tensor] = []  # the point behind each feature of each keyframe
        for k in range(keyframes):
            self.insert(se3_exp(torch.tensor([-0.05 * k, 0, 0, 0, -0.01 * k, 0], dtype=torch.float64)))

    def look(self, T_cw: Tensor) -> tuple[Features, Tensor]:
        in_camera = self.points @ T_cw[:3, :3].T + T_cw[:3, 3]
        uv = CAMERA.project(in_camera)
        which = torch.nonzero(((uv > 0) & (uv < torch.tensor([639, 479]))).all(dim=1))[:, 0]
        level = torch.zeros(len(which), dtype=torch.int64)
        return Features(uv[which], uv[which].long(), in_camera[which, 2], level, self.descriptors[which]), which

    def insert(self, T_cw: Tensor) -> Keyframe:
        seen, which = self.look(T_cw)
        known = torch.full((len(which),), -1)
        if self.map.keyframes:
            first = self.map.keyframes[0].landmarks[self.seen[0].argsort()]  # of each point, the first sees all
            known = torch.where(which < SHARED, first[which], -1)
        self.seen.append(which)
        index = len(self.map.keyframes)
        return self.map.insert_keyframe(index, index / 30, T_cw, seen, known)

    def landmarks_of(self, point: int) -> set[int]:
        """Landmarks that some keyframe takes the point for."""
        keyframes = zip(self.map.keyframes, self.seen, strict=True)
        return {int(mark) for keyframe, which in keyframes for mark in keyframe.landmarks[which == point]}

    def search(self, *overrides: str) -> None:
        LandmarkFusion(load_config(overrides=overrides), CAMERA)(self.map, self.map.keyframes[-1])
        assert_consistent(self.map)


def assert_consistent(target: SparseMap) -> None:
    """The table of observations and the keyframes' own lists say the same."""
    table = target.observations
    rows = torch.nonzero(table["valid"])[:, 0]
    told = sorted(zip(*(table[name][rows].tolist() for name in ("keyframe", "feature", "landmark")), strict=True))
    own = [
        (keyframe.index, feature, int(keyframe.landmarks[feature]))
        for keyframe in target.keyframes
        for feature in torch.nonzero(keyframe.landmarks >= 0)[:, 0].tolist()
    ]
    assert told == own
    assert all(len(keyframe.landmark_ids.unique()) == len(keyframe.landmark_ids) for keyframe in target.keyframes)
    assert target.landmarks["alive"][table["landmark"][rows]].all()


def test_landmarks_of_one_point_become_one_the_oldest() -> None:
    room = Room()
    doubled = [point for point in range(SHARED, POINTS) if len(room.landmarks_of(point)) == 3]
    assert len(doubled) > 90
    oldest = [min(room.landmarks_of(point)) for point in doubled]
    room.search()
    assert [room.landmarks_of(point) for point in doubled] == [{mark} for mark in oldest]
    assert room.map.count_shared(torch.tensor(oldest)).tolist() == 3 * [len(doubled)]


def test_counts_of_what_was_found_add_up() -> None:
    room = Room(2)
    one, other = sorted(room.landmarks_of(SHARED))
    room.map.landmarks["found"][[one, other]] = torch.tensor([3, 4])
    room.map.landmarks["visible"][[one, other]] = torch.tensor([5, 7])
    room.search()
    assert (int(room.map.landmarks["found"][one]), int(room.map.landmarks["visible"][one])) == (7, 12)


def test_a_feature_without_landmark_becomes_an_observation() -> None:
    room = Room(2)
    first = room.map.keyframes[0]
    bare = torch.nonzero((room.seen[0] >= SHARED) & (room.seen[0] % 4 == 0) & torch.isin(room.seen[0], room.seen[1]))
    table = room.map.observations
    room.map.remove_observations(torch.nonzero((table["keyframe"] == 0) & torch.isin(table["feature"], bare))[:, 0])
    assert (first.landmarks[bare] == -1).all() and len(bare) > 20
    room.search()
    assert (first.landmarks[bare] >= 0).all()
    assert all(len(room.landmarks_of(int(room.seen[0][feature]))) == 1 for feature in bare)


def test_what_one_keyframe_sees_side_by_side_stays_two() -> None:
    room = Room(2)
    points = torch.tensor([SHARED, SHARED + 1])
    # A third keyframe takes each landmark of a point for another thing.
    pairs = [sorted(room.landmarks_of(int(point))) for point in points]
    apart = torch.tensor([*pairs[0], *pairs[1]])
    away = features(4, depth=0.0, seed=77)
    room.map.insert_keyframe(2, 2 / 30, EYE, away, apart)
    room.seen.append(torch.full((4,), -1))
    LandmarkFusion(Config(), CAMERA)(room.map, room.map.keyframes[1])
    assert [sorted(room.landmarks_of(int(point))) for point in points] == pairs
    assert len(room.landmarks_of(SHARED + 2)) == 1


def test_neither_what_looks_different_nor_what_lies_elsewhere_is_joined() -> None:
    room = Room(2)
    second = room.map.keyframes[1]
    beyond, other = SHARED, SHARED + 1
    mark = second.landmarks[room.seen[1] == beyond]
    room.map.landmarks["point"][mark] += torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)  # 15 pixels and more
    room.map.landmarks["descriptor"][second.landmarks[room.seen[1] == other]] ^= 255
    second.features.descriptors[room.seen[1] == other] ^= 255
    second.features.uv[room.seen[1] == beyond] += AWAY
    room.search()
    assert len(room.landmarks_of(beyond)) == len(room.landmarks_of(other)) == 2


def test_a_place_that_depth_contradicts_is_not_joined() -> None:
    room = Room(2)
    second = room.map.keyframes[1]
    mark = second.landmarks[room.seen[1] == SHARED]
    first, seen = room.map.keyframes[0], room.map.landmarks["point"][mark]
    eye = -first.T_cw[:3, :3].T @ first.T_cw[:3, 3]
    room.map.landmarks["point"][mark] = eye + 1.3 * (seen - eye)  # on the same ray of the first, behind its surface
    second.features.uv[room.seen[1] == SHARED] += AWAY
    room.search()
    assert len(room.landmarks_of(SHARED)) == 2


def test_without_neighbours_nothing_is_joined() -> None:
    room = Room(3)
    before = [keyframe.landmarks.clone() for keyframe in room.map.keyframes]
    room.search("mapping.fusion_keyframes=0")
    assert all(torch.equal(old, now.landmarks) for old, now in zip(before, room.map.keyframes, strict=True))


@settings(deadline=None, max_examples=25)
@given(st.lists(st.lists(st.integers(-1, 30), min_size=8, max_size=8), min_size=1, max_size=5), st.integers(0, 2**16))
def test_whatever_is_fused_table_and_keyframes_agree(found: list[list[int]], seed: int) -> None:
    target = sparse_map()
    for k in range(4):
        target.insert_keyframe(k, k / 30, EYE, features(8, seed=seed + k), torch.full((8,), -1))
    for k, marks in enumerate(found):
        once = torch.tensor(marks)
        repeated = torch.tensor([mark in marks[:i] for i, mark in enumerate(marks)])
        once[repeated | ~target.landmarks["alive"][once.clamp(min=0)]] = -1  # as a search gives them
        target.fuse_landmarks(target.keyframes[k % 4], once)
        assert_consistent(target)
