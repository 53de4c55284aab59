"""The map against plain counting; local bundle adjustment on a scene with known truth; when keyframes are made."""

from __future__ import annotations

import random

import pytest
import torch
from helpers.sparse_maps import CAMERA, EYE, features, numbers, sparse_map
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.local_bundle_adjustment import local_bundle_adjust
from v3d_torch.mapping.mapper import Mapper
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.tensor_table import TensorTable, unique_ids
from v3d_torch.types import FramePose, RGBDFrame, TrackingStatus


def insert(target: SparseMap, landmarks: list[int], T_cw: Tensor = EYE, seed: int = 0) -> Keyframe:
    """A keyframe whose features are the given landmarks, and no new ones as they have no depth."""
    seen = features(len(landmarks), seed=seed, depth=0.0)
    index = len(target.keyframes)
    return target.insert_keyframe(index, index / 30, T_cw, seen, torch.tensor(landmarks, dtype=torch.int64))


# --- the table


@settings(deadline=None, max_examples=30)
@given(st.lists(st.integers(0, 300), max_size=8))
def test_table_keeps_what_is_appended(counts: list[int]) -> None:
    table = TensorTable(number=((), torch.int64), place=((2,), torch.float64))
    expected = torch.zeros(0, 2, dtype=torch.float64)
    for turn, count in enumerate(counts):
        places = numbers(count, 2, seed=turn)
        rows = table.append(number=torch.arange(count), place=places)
        assert rows.tolist() == list(range(len(expected), len(expected) + count))
        expected = torch.cat([expected, places])
    assert len(table) == len(expected)
    assert torch.equal(table["place"], expected)
    assert table["number"].tolist() == [number for count in counts for number in range(count)]


@given(st.lists(st.integers(0, 30), max_size=40))
def test_distinct_numbers_are_those_of_unique(numbers_: list[int]) -> None:
    given_ = torch.tensor(numbers_, dtype=torch.int64)
    for ours, theirs in zip(unique_ids(given_, 31), given_.unique(return_inverse=True), strict=True):
        assert torch.equal(ours, theirs)


def test_a_column_is_a_view_and_rows_are_whole() -> None:
    table = TensorTable(number=((), torch.int64), flag=((), torch.bool))
    table.append(number=torch.arange(3), flag=torch.zeros(3, dtype=torch.bool))
    table["number"][1] = 7
    assert table["number"].tolist() == [0, 7, 2]
    with pytest.raises(KeyError, match="flag"):
        table.append(number=torch.arange(3))
    assert len(table) == 3


# --- landmarks


def test_convention_landmarks_lie_where_their_keyframe_saw_them() -> None:
    T_cw = se3_exp(torch.tensor([0.3, -0.2, 0.1, 0.1, 0.4, -0.2], dtype=torch.float64))
    seen = features(50)
    target = sparse_map()
    keyframe = target.insert_keyframe(0, 0.0, T_cw, seen, torch.full((50,), -1))
    points = target.landmarks["point"]
    in_camera = points @ T_cw[:3, :3].T + T_cw[:3, 3]
    assert torch.equal(keyframe.landmarks, torch.arange(50))
    torch.testing.assert_close(CAMERA.project(in_camera), seen.uv, rtol=0, atol=1e-9)
    torch.testing.assert_close(in_camera[:, 2], seen.depth, rtol=0, atol=1e-12)
    sight = points - invert(T_cw)[:3, 3]
    torch.testing.assert_close(target.landmarks["direction"] * sight.norm(dim=1, keepdim=True), sight)
    # Seen on level n at distance d, a landmark is as large on level 0 at d * 1.2^n.
    torch.testing.assert_close(target.landmarks["reference_distance"], sight.norm(dim=1) * 1.2 ** seen.octave.double())


def test_new_landmarks_have_depth_are_new_and_as_many_as_wanted() -> None:
    target = sparse_map(landmarks_per_keyframe=60)
    insert(target, [])
    first = target.insert_keyframe(1, 0.0, EYE, features(200), torch.full((200,), -1))
    made = first.landmarks >= 0
    assert made.sum() == 60
    assert (features(200).depth[made] > 0).all()
    known = torch.full((200,), -1)
    known[:25] = torch.arange(25)
    second = target.insert_keyframe(2, 0.1, EYE, features(200), known)
    assert torch.equal(second.landmarks[:25], torch.arange(25))
    assert (second.landmarks >= 0).sum() == 60
    assert len(target.landmarks) == 60 + 35


def test_a_far_scene_is_mapped_too() -> None:
    target = sparse_map()
    assert (target.insert_keyframe(0, 0.0, EYE, features(120, depth=6.0), torch.full((120,), -1)).landmarks >= 0).all()


# --- who sees whom


@pytest.fixture
def seeing() -> tuple[SparseMap, list[set[int]]]:
    """A map of 40 landmarks and 12 keyframes that see some of them, and the same as plain sets."""
    target = sparse_map()
    target.insert_keyframe(0, 0.0, EYE, features(40), torch.full((40,), -1))
    sets = [set(range(40))]
    dice = random.Random(3)  # noqa: S311
    for seed in range(11):
        chosen = sorted(dice.sample(range(40), dice.randint(2, 20)))
        insert(target, chosen, seed=seed)
        sets.append(set(chosen))
    return target, sets


def test_covisibility_equals_plain_counting(seeing: tuple[SparseMap, list[set[int]]]) -> None:
    target, sets = seeing
    wanted = {1, 5, 8, 13, 21, 34}
    counts = [len(wanted & seen) for seen in sets]
    assert target.count_shared(torch.tensor(sorted(wanted))).tolist() == counts
    expected = sorted((k for k in range(12) if counts[k]), key=lambda k: (-counts[k], -k))[
        :5
    ]  # the newest of equals first
    assert target.covisible_keyframes(torch.tensor(sorted(wanted)), 5).tolist() == expected
    pairs = [[i, j] for i in range(12) for j in range(i + 1, 12) if len(sets[i] & sets[j]) >= 7 or j == i + 1]
    assert target.covisibility_edges(7).tolist() == pairs


def test_the_local_map_is_what_the_best_keyframes_see(seeing: tuple[SparseMap, list[set[int]]]) -> None:
    target, sets = seeing
    target.landmarks["alive"][3] = False
    best = target.covisible_keyframes(torch.tensor([2, 9]), 3).tolist()
    local = target.local_map(torch.tensor([2, 9]), 3)
    assert local.ids.tolist() == sorted(set.union(*(sets[k] for k in best)) - {3})
    assert torch.equal(local.points, target.landmarks["point"][local.ids])
    assert torch.equal(local.descriptors, target.landmarks["descriptor"][local.ids])
    assert len(target.local_map(torch.zeros(0, dtype=torch.int64), 3).ids) == 0


def test_forgotten_observations_no_longer_count(seeing: tuple[SparseMap, list[set[int]]]) -> None:
    target, _ = seeing
    table = target.observations
    rows = torch.nonzero((table["keyframe"] == 4) & (table["landmark"] % 2 == 0))[:, 0]
    gone = table["landmark"][rows]
    kept = target.keyframes[4].landmarks[target.keyframes[4].landmarks % 2 == 1]
    assert target.count_shared(gone)[4] == len(gone) > 0
    target.remove_observations(rows)
    assert target.count_shared(gone)[4] == 0
    assert target.count_shared(kept)[4] == len(kept)
    assert target.keyframes[4].landmarks[target.keyframes[4].landmarks >= 0].tolist() == kept.tolist()


def test_fused_landmarks_are_one(seeing: tuple[SparseMap, list[set[int]]]) -> None:
    target, sets = seeing
    last = target.insert_keyframe(12, 0.4, EYE, features(6, seed=50), torch.full((6,), -1))
    known = torch.tensor([4, -1, 7, -1, -1, 30])  # what three of its six landmarks turned out to be
    doubles = last.landmarks[[0, 2, 5]].tolist()
    target.fuse_landmarks(last, known)
    assert last.landmarks.tolist() == [4, 41, 7, 43, 44, 30]
    assert not target.landmarks["alive"][doubles].any()
    assert not torch.isin(target.observations["landmark"], torch.tensor(doubles)).any()
    assert target.count_shared(torch.tensor([4, 7, 30])).tolist() == [len({4, 7, 30} & seen) for seen in sets] + [3]


def test_a_map_without_landmarks_has_none_to_drop() -> None:
    target = sparse_map()
    blind = target.insert_keyframe(0, 0.0, EYE, features(5, depth=0.0), torch.full((5,), -1))
    target.compact([blind.landmarks.clone()])
    assert len(target.landmarks) == 0 and blind.landmarks.tolist() == [-1] * 5


def test_culling_keeps_what_is_found_again() -> None:
    target = sparse_map()
    target.insert_keyframe(0, 0.0, EYE, features(4), torch.full((4,), -1))
    everything = torch.arange(4)
    for turn in range(8):  # landmark 0 is found always, 1 every second time, 2 once, 3 never
        found = torch.tensor([0, 1 if turn % 2 else -1, 2 if turn == 0 else -1, -1])
        target.count_matches(found, everything)
    target.cull_landmarks()
    assert target.landmarks["alive"].all()  # no judgement before the next keyframe
    insert(target, [0, 1, 2, 3])
    target.cull_landmarks()
    assert target.landmarks["alive"].tolist() == [True, True, False, False]


def test_culling_drops_landmarks_that_no_second_keyframe_saw() -> None:
    target = sparse_map()
    target.insert_keyframe(0, 0.0, EYE, features(3), torch.full((3,), -1))
    for _ in range(2):
        insert(target, [1])
        target.cull_landmarks()
    assert target.landmarks["alive"].all()
    insert(target, [])
    target.cull_landmarks()
    assert target.landmarks["alive"].tolist() == [False, True, False]


def test_landmarks_go_along_with_the_keyframe_that_made_them() -> None:
    target = sparse_map()
    target.insert_keyframe(0, 0.0, EYE, features(20), torch.full((20,), -1))
    target.insert_keyframe(1, 0.1, EYE, features(30, seed=9), torch.full((30,), -1))
    before = target.landmarks["point"].clone()
    T_cw = se3_exp(torch.tensor([0.5, 0.1, -0.3, 0.2, 0.0, 0.3], dtype=torch.float64))
    target.move_keyframes(torch.stack([EYE, T_cw]))
    assert torch.equal(target.landmarks["point"][:20], before[:20])
    # What a camera sees does not change when camera and landmarks move together.
    moved = target.landmarks["point"][20:] @ T_cw[:3, :3].T + T_cw[:3, 3]
    torch.testing.assert_close(moved, before[20:], rtol=0, atol=1e-12)
    directions = target.landmarks["direction"][20:] @ T_cw[:3, :3].T
    torch.testing.assert_close(directions, before[20:] / before[20:].norm(dim=1, keepdim=True), rtol=0, atol=1e-12)
    assert torch.equal(target.keyframes[1].T_cw, T_cw)


# --- local bundle adjustment


class Walk:
    """Cameras that step sideways along 300 points; what they measure is true up to noise, their poses are wrong."""

    def __init__(self, keyframes: int, error: float) -> None:
        # Twice the width of the image: new ones come into view as others leave it.
        self.points = CAMERA.back_project(features(300, seed=1).uv * torch.tensor([2, 1]), 2 + numbers(300, seed=2))
        self.map = sparse_map()
        o = torch.zeros(keyframes, dtype=torch.float64)
        steps = torch.arange(keyframes, dtype=torch.float64)
        self.T_cw = se3_exp(torch.stack([-0.1 * steps, o, o, o, -0.01 * steps, o], dim=1))
        wrong = error * torch.randn(keyframes, 6, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
        wrong[0] = 0
        start = se3_exp(wrong) @ self.T_cw
        ids = torch.full((300,), -1)
        for k in range(keyframes):
            seen, which = self.look(k)
            keyframe = self.map.insert_keyframe(k, k / 30, start[k], seen, ids[which])
            ids[which] = keyframe.landmarks

    def look(self, k: int) -> tuple[Features, Tensor]:
        in_camera = self.points @ self.T_cw[k, :3, :3].T + self.T_cw[k, :3, 3]
        uv = CAMERA.project(in_camera)
        which = torch.nonzero(((uv > 0) & (uv < torch.tensor([640, 480]))).all(dim=1))[:, 0]
        noise = 0.2 * torch.randn(len(which), 2, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
        zeros = torch.zeros(len(which), dtype=torch.int64)
        descriptors = torch.zeros(len(which), 32, dtype=torch.uint8)
        uv = uv[which] + noise
        return Features(uv, uv.long(), in_camera[which, 2], zeros, descriptors), which

    def errors(self) -> Tensor:
        """Distance of each camera to its true place, metres."""
        T_wc = invert(torch.stack([keyframe.T_cw for keyframe in self.map.keyframes]))
        return (T_wc - invert(self.T_cw))[:, :3, 3].norm(dim=1)


def adjust(sparse_map: SparseMap, config: Config) -> None:
    """Adjust the neighbourhood of the newest keyframe."""
    adjustment = local_bundle_adjust(sparse_map, sparse_map.keyframes[-1], config, CAMERA)
    assert adjustment is not None
    adjustment.apply(sparse_map)


def test_local_adjustment_finds_the_true_poses() -> None:
    walk = Walk(keyframes=6, error=0.01)
    before = walk.errors()
    for _ in range(3):
        adjust(walk.map, Config())
    assert before.max() > 0.02
    assert walk.errors().max() < 0.003
    assert torch.equal(walk.map.keyframes[0].T_cw, EYE)  # the first is the world


def test_while_an_adjustment_is_solved_the_map_stays_as_it_is() -> None:
    walk = Walk(keyframes=6, error=0.01)
    before, points = walk.map.T_cw, walk.map.landmarks["point"].clone()
    adjustment = local_bundle_adjust(walk.map, walk.map.keyframes[-1], Config(), CAMERA)
    assert adjustment is not None
    assert torch.equal(walk.map.T_cw, before) and torch.equal(walk.map.landmarks["point"], points)
    assert walk.map.observations["valid"].all()
    adjustment.apply(walk.map)
    torch.testing.assert_close(walk.map.T_cw, adjustment.T_cw, rtol=0, atol=0)
    assert (walk.map.T_cw - before).abs().max() > 0.005


def test_local_adjustment_moves_the_neighbourhood_only() -> None:
    walk = Walk(keyframes=12, error=0.01)
    before = [keyframe.T_cw.clone() for keyframe in walk.map.keyframes]
    config = load_config(overrides=["mapping.bundle_keyframes=4"])
    adjust(walk.map, config)
    moved = [not torch.equal(keyframe.T_cw, old) for keyframe, old in zip(walk.map.keyframes, before, strict=True)]
    assert moved == [False] * 8 + [True] * 4


def test_without_bundle_keyframes_nothing_is_adjusted() -> None:
    walk = Walk(keyframes=4, error=0.01)
    config = load_config(overrides=["mapping.bundle_keyframes=0"])
    assert local_bundle_adjust(walk.map, walk.map.keyframes[-1], config, CAMERA) is None


def test_local_adjustment_forgets_what_does_not_fit() -> None:
    walk = Walk(keyframes=6, error=0.0)
    table = walk.map.observations
    wrong = torch.nonzero((table["keyframe"] == 5) & (table["landmark"] % 20 == 0))[:, 0]
    table["uv"][wrong] += 50.0
    adjust(walk.map, Config())
    assert len(wrong) > 5
    assert not table["valid"][wrong].any()
    assert table["valid"].double().mean() > 0.98
    assert (walk.map.keyframes[5].landmarks[table["feature"][wrong]] == -1).all()
    assert walk.errors().max() < 0.006
    adjust(walk.map, Config())  # without them
    assert walk.errors().max() < 0.003


# --- when a frame becomes a keyframe


class Frames:
    """Frames as the mapper sees them: how many landmarks each of them found is all that matters."""

    def __init__(self, **settings_: int | float) -> None:
        overrides = [f"mapping.{key}={value}" for key, value in settings_.items()]
        self.mapper = Mapper(load_config(overrides=[*overrides, "mapping.bundle_keyframes=0"]), CAMERA)
        self.index = -1

    def __call__(self, found: int, status: TrackingStatus = TrackingStatus.TRACKED, features_: int = 400) -> bool:
        """Take in the next frame, 1/30 s after the one before; whether it became a keyframe."""
        self.index += 1
        image, depth = torch.zeros(3, 480, 640, dtype=torch.uint8), torch.zeros(1, 480, 640)
        landmarks = torch.full((features_,), -1)
        landmarks[:found] = torch.arange(found)
        frame = RGBDFrame(self.index, self.index / 30, image, depth)
        keyframes = self.mapper.map.keyframes
        reference = keyframes[-1] if keyframes else None
        estimate = FramePose(status, EYE, landmarks)
        return self.mapper(frame, features(features_), estimate, reference) is not None


def test_keyframes_come_when_tracking_gets_weak() -> None:
    take = Frames(max_gap=100, min_tracked=100, min_tracked_ratio=0.7)
    assert take(0, TrackingStatus.LOST)
    assert [take(found) for found in (300, 290, 211, 209)] == [False, False, False, True]
    assert [take(found) for found in (150, 110, 104)] == [False, False, True]  # below 0.7 of 150
    assert [take(found) for found in (120, 101, 99)] == [False, False, True]  # below the least count


def test_keyframes_come_at_the_latest_after_the_gap() -> None:
    take = Frames(max_gap=5)
    made = [take(0, TrackingStatus.LOST)] + [take(300) for _ in range(15)]
    assert [index for index, keyframe in enumerate(made) if keyframe] == [0, 5, 10, 15]


def test_odometry_is_mapped_after_its_patience_so_that_the_map_goes_on() -> None:
    take = Frames(odometry_after=0.3, max_gap=1000)
    assert take(0, TrackingStatus.LOST)
    for _ in range(2):  # a frame that finds the map starts the patience anew
        assert [take(0, TrackingStatus.ODOMETRY) for _ in range(8)] == [False] * 8
        assert not take(300)
    made = [take(0, TrackingStatus.ODOMETRY) for _ in range(20)]
    assert made.index(True) in (9, 10)  # 0.3 s at 30 frames a second
    assert not take.mapper.map.keyframes[-1].disconnected


def test_no_map_starts_where_too_little_is_seen() -> None:
    take = Frames(min_tracked=100)
    assert not take(0, TrackingStatus.LOST, features_=99)
    assert take(0, TrackingStatus.LOST, features_=100)


def test_a_lost_camera_maps_on_disconnected_after_its_patience() -> None:
    take = Frames(restart_after=0.5)
    assert take(0, TrackingStatus.LOST)
    made = [take(0, TrackingStatus.LOST) for _ in range(20)]
    assert made.index(True) in (15, 16)  # half a second at 30 frames a second
    first, second = take.mapper.map.keyframes[:2]
    assert not first.disconnected and second.disconnected
    take(5)
    assert take.mapper.map.keyframes[-1].disconnected  # what is tied to it is disconnected as well


def test_a_covered_camera_is_given_time_to_find_its_place_when_it_sees_again() -> None:
    take = Frames(restart_after=0.5)
    assert take(0, TrackingStatus.LOST)
    assert [take(0, TrackingStatus.LOST, features_=20) for _ in range(40)] == [False] * 40
    made = [take(0, TrackingStatus.LOST) for _ in range(20)]
    assert made.index(True) in (15, 16)


def test_patience_starts_anew_when_the_camera_is_found() -> None:
    take = Frames(restart_after=0.5, max_gap=1000)
    assert take(0, TrackingStatus.LOST)
    for _ in range(3):
        assert [take(0, TrackingStatus.LOST) for _ in range(10)] == [False] * 10
        assert not take(300)
