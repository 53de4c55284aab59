"""The sparse map: created landmarks, local map, edits, readout, state; covisibility and ids against plain sets."""

from __future__ import annotations

import copy
import random

import pytest
import torch
from helpers import rolling_camera
from helpers.rolling_camera import KINECT, VELOCITY, observe_rolling, points_in_view
from helpers.sparse_maps import CAMERA, EYE, features, make_map
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.covisibility import count_shared_landmarks, covisibility_edges, covisible_keyframes
from v3d_torch.mapping.culling import cull_keyframes
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.mapping.landmark_ids import compact_landmarks
from v3d_torch.mapping.map_observations import unique_ids
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout, compensate_features


def insert(sparse_map: SparseMap, landmarks: list[int], T_cw: Tensor = EYE, seed: int = 0) -> Keyframe:
    """Insert a keyframe that observes the given landmarks and creates none, because its features have no depth."""
    observed = features(len(landmarks), seed=seed, depth=0.0)
    index = len(sparse_map.keyframes)
    return sparse_map.insert_keyframe(index, index / 30, T_cw, observed, torch.tensor(landmarks, dtype=torch.int64))


def unmatched(count: int) -> Tensor:
    return torch.full((count,), -1)


# --- creation of landmarks


def test_convention_landmarks_project_to_the_features_of_their_keyframe() -> None:
    T_cw = se3_exp(torch.tensor([0.3, -0.2, 0.1, 0.1, 0.4, -0.2], dtype=torch.float64))
    observed = features(50)
    sparse_map = make_map()
    keyframe = sparse_map.insert_keyframe(0, 0.0, T_cw, observed, unmatched(50))
    points = sparse_map.landmarks["point"]
    in_camera = points @ T_cw[:3, :3].T + T_cw[:3, 3]
    assert torch.equal(keyframe.landmarks, torch.arange(50))
    torch.testing.assert_close(CAMERA.project(in_camera), observed.uv, rtol=0, atol=1e-9)
    torch.testing.assert_close(in_camera[:, 2], observed.depth, rtol=0, atol=1e-12)
    ray = points - invert(T_cw)[:3, 3]
    torch.testing.assert_close(sparse_map.landmarks["direction"] * ray.norm(dim=1, keepdim=True), ray)
    # A landmark on level n at distance d has the same size on level 0 at d * 1.2^n.
    expected = ray.norm(dim=1) * 1.2 ** observed.octave.double()
    torch.testing.assert_close(sparse_map.landmarks["reference_distance"], expected)


def test_new_landmarks_come_from_unmatched_features_with_depth_up_to_the_maximum() -> None:
    sparse_map = make_map(landmarks_per_keyframe=60)
    insert(sparse_map, [])
    first = sparse_map.insert_keyframe(1, 0.0, EYE, features(200), unmatched(200))
    created = first.landmarks >= 0
    assert created.sum() == 60
    assert (features(200).depth[created] > 0).all()
    matched = unmatched(200)
    matched[:25] = torch.arange(25)
    second = sparse_map.insert_keyframe(2, 0.1, EYE, features(200), matched)
    assert torch.equal(second.landmarks[:25], torch.arange(25))
    assert (second.landmarks >= 0).sum() == 60
    assert len(sparse_map.landmarks) == 60 + 35


def test_keyframe_that_observes_more_landmarks_than_the_maximum_creates_none() -> None:
    """As with a lower maximum in a map of an earlier run, or with more features than landmarks per keyframe."""
    sparse_map = make_map(landmarks_per_keyframe=60)
    insert(sparse_map, [])
    sparse_map.insert_keyframe(1, 0.0, EYE, features(200), unmatched(200))
    sparse_map.insert_keyframe(2, 0.1, EYE, features(200, seed=1), unmatched(200))
    matched = unmatched(200)
    matched[:70] = torch.arange(70)
    third = sparse_map.insert_keyframe(3, 0.2, EYE, features(200), matched)
    assert torch.equal(third.landmarks, matched) and len(sparse_map.landmarks) == 120


def test_distant_features_create_landmarks() -> None:
    keyframe = make_map().insert_keyframe(0, 0.0, EYE, features(120, depth=6.0), unmatched(120))
    assert (keyframe.landmarks >= 0).all()


def test_empty_map_has_the_readout_of_the_camera_or_the_expected_one() -> None:
    config = Config()
    expected = Readout(config.rolling_shutter.readout, config.rolling_shutter.readout_sigma**-2)
    assert SparseMap.empty(config, CAMERA).readout == expected
    disabled = load_config(overrides=["rolling_shutter.enabled=false"])
    assert SparseMap.empty(disabled, CAMERA).readout == GLOBAL_SHUTTER
    assert len(SparseMap.empty(config, CAMERA).keyframes) == len(SparseMap.empty(config, CAMERA).landmarks) == 0


# --- covisibility


@pytest.fixture
def observed_sets() -> tuple[SparseMap, list[set[int]]]:
    """A map with 40 landmarks and 12 keyframes, and the landmarks that each keyframe observes as plain sets."""
    sparse_map = make_map()
    sparse_map.insert_keyframe(0, 0.0, EYE, features(40), unmatched(40))
    sets = [set(range(40))]
    dice = random.Random(3)  # noqa: S311
    for seed in range(11):
        chosen = sorted(dice.sample(range(40), dice.randint(2, 20)))
        insert(sparse_map, chosen, seed=seed)
        sets.append(set(chosen))
    return sparse_map, sets


def test_covisibility_equals_plain_counting(observed_sets: tuple[SparseMap, list[set[int]]]) -> None:
    sparse_map, sets = observed_sets
    wanted = {1, 5, 8, 13, 21, 34}
    counts = [len(wanted & observed) for observed in sets]
    assert count_shared_landmarks(sparse_map, torch.tensor(sorted(wanted))).tolist() == counts
    newest_of_equals_first = sorted((k for k in range(12) if counts[k]), key=lambda k: (-counts[k], -k))
    assert covisible_keyframes(sparse_map, torch.tensor(sorted(wanted)), 5).tolist() == newest_of_equals_first[:5]
    pairs = [[i, j] for i in range(12) for j in range(i + 1, 12) if len(sets[i] & sets[j]) >= 7 or j == i + 1]
    assert covisibility_edges(sparse_map, 7).tolist() == pairs


def test_consecutive_keyframes_of_different_parts_have_no_edge() -> None:
    sparse_map = make_map()
    for part in (0, 0, 1, 1, 2, 2, 0, 0):
        insert(sparse_map, []).part = part
    assert covisibility_edges(sparse_map, 1).tolist() == [[0, 1], [2, 3], [4, 5], [6, 7]]


@pytest.mark.parametrize(
    ("a", "b", "parts"), [(0, 2, [0, 1, 0]), (2, 0, [0, 1, 0]), (2, 1, [0, 1, 1]), (1, 1, [0, 1, 2])]
)
def test_joined_parts_have_the_lower_id(a: int, b: int, parts: list[int]) -> None:
    sparse_map = make_map()
    for part in range(3):
        insert(sparse_map, []).part = part
    assert sparse_map.unused_part == 3
    sparse_map.join_parts(a, b)
    assert [keyframe.part for keyframe in sparse_map.keyframes] == parts
    assert [keyframe.is_disconnected for keyframe in sparse_map.keyframes] == [part > 0 for part in parts]


def test_local_map_is_the_active_landmarks_of_the_most_covisible_keyframes(
    observed_sets: tuple[SparseMap, list[set[int]]],
) -> None:
    sparse_map, sets = observed_sets
    sparse_map.landmarks["active"][3] = False
    best = covisible_keyframes(sparse_map, torch.tensor([2, 9]), 3).tolist()
    local = sparse_map.local_map(torch.tensor([2, 9]), 3)
    assert local.ids.tolist() == sorted(set.union(*(sets[k] for k in best)) - {3})
    assert torch.equal(local.points, sparse_map.landmarks["point"][local.ids])
    assert torch.equal(local.descriptors, sparse_map.landmarks["descriptor"][local.ids])
    assert len(sparse_map.local_map(torch.zeros(0, dtype=torch.int64), 3).ids) == 0


def test_local_map_has_the_landmarks_of_removed_observations(observed_sets: tuple[SparseMap, list[set[int]]]) -> None:
    """They are in view of the keyframe, whose other landmarks make it covisible."""
    sparse_map, sets = observed_sets
    best = int(covisible_keyframes(sparse_map, torch.tensor([2, 9]), 1))
    table = sparse_map.observations
    outlier = min(sets[best] - {2, 9})
    sparse_map.remove_observations(torch.nonzero((table["keyframe"] == best) & (table["landmark"] == outlier))[:, 0])
    assert count_shared_landmarks(sparse_map, torch.tensor([outlier]))[best] == 0
    assert sparse_map.local_map(torch.tensor([2, 9]), 1).ids.tolist() == sorted(sets[best])


# --- edits


def test_removed_observations_do_not_count(observed_sets: tuple[SparseMap, list[set[int]]]) -> None:
    sparse_map, _ = observed_sets
    table = sparse_map.observations
    rows = torch.nonzero((table["keyframe"] == 4) & (table["landmark"] % 2 == 0))[:, 0]
    removed = table["landmark"][rows]
    kept = sparse_map.keyframes[4].landmarks[sparse_map.keyframes[4].landmarks % 2 == 1]
    assert count_shared_landmarks(sparse_map, removed)[4] == len(removed) > 0
    sparse_map.remove_observations(rows)
    assert count_shared_landmarks(sparse_map, removed)[4] == 0
    assert count_shared_landmarks(sparse_map, kept)[4] == len(kept)
    assert sparse_map.keyframes[4].landmarks[sparse_map.keyframes[4].landmarks >= 0].tolist() == kept.tolist()


def test_fused_landmarks_become_the_older_landmark(observed_sets: tuple[SparseMap, list[set[int]]]) -> None:
    sparse_map, sets = observed_sets
    newest = sparse_map.insert_keyframe(12, 0.4, EYE, features(6, seed=50), unmatched(6))
    matches = torch.tensor([4, -1, 7, -1, -1, 30])
    duplicates = newest.landmarks[[0, 2, 5]].tolist()
    sparse_map.fuse_landmarks(newest, matches)
    assert newest.landmarks.tolist() == [4, 41, 7, 43, 44, 30]
    assert not sparse_map.landmarks["active"][duplicates].any()
    assert not torch.isin(sparse_map.observations["landmark"], torch.tensor(duplicates)).any()
    counts = count_shared_landmarks(sparse_map, torch.tensor([4, 7, 30])).tolist()
    assert counts == [len({4, 7, 30} & observed) for observed in sets] + [3]


def test_compaction_of_a_map_without_landmarks_changes_nothing() -> None:
    sparse_map = make_map()
    keyframe = sparse_map.insert_keyframe(0, 0.0, EYE, features(5, depth=0.0), unmatched(5))
    compact_landmarks(sparse_map, [keyframe.landmarks.clone()])
    assert len(sparse_map.landmarks) == 0 and keyframe.landmarks.tolist() == [-1] * 5


def test_map_of_mostly_unused_landmarks_is_compacted_however_often_the_others_are_observed() -> None:
    sparse_map = make_map()
    sparse_map.insert_keyframe(0, 0.0, EYE, features(60), unmatched(60))
    newest = [insert(sparse_map, list(range(5, 25)), seed=seed) for seed in range(5)][-1]
    sparse_map.landmarks["active"][20:] = False
    compact_landmarks(sparse_map, [])
    assert len(sparse_map.landmarks) == 60  # the first keyframe observes all
    cull_keyframes(sparse_map, {0: 1})
    points = sparse_map.landmarks["point"][5:25].clone()
    external = torch.tensor([24, -1, 5])
    compact_landmarks(sparse_map, [external])
    assert torch.equal(sparse_map.landmarks["point"], points) and len(sparse_map.observations) == 100
    assert external.tolist() == [19, -1, 0] and newest.landmarks.tolist() == list(range(20))


def test_landmarks_move_with_the_keyframe_that_created_them() -> None:
    sparse_map = make_map()
    sparse_map.insert_keyframe(0, 0.0, EYE, features(20), unmatched(20))
    sparse_map.insert_keyframe(1, 0.1, EYE, features(30, seed=9), unmatched(30))
    before = sparse_map.landmarks["point"].clone()
    T_cw = se3_exp(torch.tensor([0.5, 0.1, -0.3, 0.2, 0.0, 0.3], dtype=torch.float64))
    sparse_map.move_keyframes(torch.stack([EYE, T_cw]))
    assert torch.equal(sparse_map.landmarks["point"][:20], before[:20])
    # In the camera frame nothing changes.
    in_camera = sparse_map.landmarks["point"][20:] @ T_cw[:3, :3].T + T_cw[:3, 3]
    torch.testing.assert_close(in_camera, before[20:], rtol=0, atol=1e-12)
    directions = sparse_map.landmarks["direction"][20:] @ T_cw[:3, :3].T
    torch.testing.assert_close(directions, before[20:] / before[20:].norm(dim=1, keepdim=True), rtol=0, atol=1e-12)
    assert torch.equal(sparse_map.keyframes[1].T_cw, T_cw)


# --- readout


def map_of_two_keyframes(readout: Readout) -> SparseMap:
    """Map of two keyframes that observed the same points while the camera moved."""
    config = Config()
    sparse_map = SparseMap(config.mapping, config.features, rolling_camera.CAMERA)
    sparse_map.readout = readout
    rolling = observe_rolling(points_in_view(), VELOCITY, KINECT.seconds)
    observed = compensate_features(rolling, VELOCITY, readout, rolling_camera.CAMERA)
    first = sparse_map.insert_keyframe(0, 0.0, EYE, observed, unmatched(len(observed)))
    sparse_map.insert_keyframe(1, 0.1, EYE, observed, first.landmarks)
    return sparse_map


def test_set_readout_moves_all_features_and_observations() -> None:
    changed, expected = map_of_two_keyframes(Readout(0.010, 1.0)), map_of_two_keyframes(KINECT)
    changed.set_readout(KINECT)
    assert changed.readout == KINECT
    torch.testing.assert_close(changed.observations["uv"], expected.observations["uv"], rtol=0, atol=1e-9)
    for keyframe, expected_keyframe in zip(changed.keyframes, expected.keyframes, strict=True):
        torch.testing.assert_close(keyframe.features.uv, expected_keyframe.features.uv, rtol=0, atol=1e-9)


def test_update_features_moves_the_observations_of_that_keyframe_only() -> None:
    sparse_map = map_of_two_keyframes(KINECT)
    newest, others = sparse_map.keyframes[1], sparse_map.observations["keyframe"] == 0
    before = sparse_map.observations["uv"].clone()
    slower = compensate_features(newest.features, VELOCITY / 2, KINECT, rolling_camera.CAMERA)
    sparse_map.update_features(newest, slower)
    assert torch.equal(sparse_map.observations["uv"][others], before[others])
    feature = sparse_map.observations["feature"][~others]
    assert torch.equal(sparse_map.observations["uv"][~others], newest.features.uv[feature])
    assert torch.equal(sparse_map.observations["readout_jacobian"][~others], newest.features.readout_jacobian[feature])
    assert not torch.equal(sparse_map.observations["uv"][~others], before[~others])


def test_update_features_moves_the_landmarks_that_no_other_keyframe_observes() -> None:
    points = points_in_view(200)
    T_cw = se3_exp(torch.tensor([0.3, -0.2, 0.1, 0.1, 0.4, -0.2], dtype=torch.float64))
    in_camera = points @ T_cw[:3, :3].T + T_cw[:3, 3]
    visible = in_camera[:, 2] > 0.1
    points, in_camera = points[visible], in_camera[visible]
    observed = observe_rolling(in_camera, VELOCITY, KINECT.seconds)
    sparse_map = SparseMap(Config().mapping, Config().features, rolling_camera.CAMERA)
    first = sparse_map.insert_keyframe(0, 0.0, T_cw, observed, unmatched(len(observed)))
    shared = torch.where(torch.arange(len(observed)) < 50, first.landmarks, -1)
    insert(sparse_map, shared[:50].tolist())
    before = sparse_map.landmarks["point"].clone()
    sparse_map.update_features(first, compensate_features(observed, VELOCITY, KINECT, rolling_camera.CAMERA))
    created = first.landmarks >= 0
    own, landmarks = created & (shared < 0), first.landmarks
    after = sparse_map.landmarks["point"]
    assert own.sum() > 100
    assert torch.equal(after[shared[:50]], before[shared[:50]])
    error = [(each[landmarks[own]] - points[own]).norm(dim=1).median() for each in (before, after)]
    assert error[1] < 0.1 * error[0]


def test_update_features_ignores_removed_observations() -> None:
    """A landmark whose other observation is an outlier is observed by its keyframe only."""
    sparse_map = map_of_two_keyframes(KINECT)
    first, columns = sparse_map.keyframes[0], sparse_map.observations
    shared = torch.bincount(columns["landmark"]) == 2
    of_first = columns["keyframe"] == 0
    lonely, gone = torch.nonzero(shared)[:2, 0].tolist()
    sparse_map.remove_observations(torch.nonzero(~of_first & (columns["landmark"] == lonely))[:, 0])
    sparse_map.remove_observations(torch.nonzero(of_first & (columns["landmark"] == gone))[:, 0])
    before = sparse_map.landmarks["point"].clone()
    shift = se3_exp(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    sparse_map.update_features(first, first.features, shift @ first.T_cw)
    moved = (sparse_map.landmarks["point"] - before).norm(dim=1)
    assert moved[lonely] == pytest.approx(0.5, abs=1e-6) and moved[gone] == 0
    assert (moved[torch.nonzero(shared)[2:, 0]] == 0).all()


def test_update_features_leaves_the_landmarks_of_a_keyframe_whose_pose_depends_on_others() -> None:
    sparse_map = map_of_two_keyframes(KINECT)
    newest, before = sparse_map.keyframes[1], sparse_map.landmarks["point"].clone()
    assert set(sparse_map.landmarks["keyframe"][newest.landmarks[newest.landmarks >= 0]].tolist()) >= {0}
    slower = compensate_features(newest.features, VELOCITY / 2, KINECT, rolling_camera.CAMERA)
    sparse_map.update_features(newest, slower)
    assert torch.equal(sparse_map.landmarks["point"], before)


def test_landmark_positions_are_those_of_active_landmarks() -> None:
    sparse_map = map_of_two_keyframes(KINECT)
    first = sparse_map.keyframes[0]
    landmark_ids = torch.where(torch.arange(len(first.landmarks)) % 2 == 0, first.landmarks, -1)
    sparse_map.landmarks["active"][landmark_ids[4]] = False
    found, points = sparse_map.landmark_positions(landmark_ids)
    assert found.tolist() == [i for i in range(0, len(landmark_ids), 2) if i != 4]
    assert torch.equal(points, sparse_map.landmarks["point"][first.landmarks[found]])


# --- state


def assert_equal_tables(a: SparseMap, b: SparseMap) -> None:
    for ours, other in ((a.landmarks, b.landmarks), (a.observations, b.observations)):
        assert ours.columns.keys() == other.columns.keys()
        assert all(torch.equal(column, other[name]) for name, column in ours.columns.items())
    for own, restored in zip(a.keyframes, b.keyframes, strict=True):
        assert torch.equal(own.landmarks, restored.landmarks) and torch.equal(own.T_cw, restored.T_cw)
        assert torch.equal(own.features.uv, restored.features.uv)
        assert (own.index, own.stamp, own.reference) == (restored.index, restored.stamp, restored.reference)
    for own_loop, restored_loop in zip(a.loops, b.loops, strict=True):
        assert (own_loop.i, own_loop.j) == (restored_loop.i, restored_loop.j)
        assert torch.equal(own_loop.T_ij, restored_loop.T_ij)
    assert a.readout == b.readout


def test_map_with_the_state_of_another_map_continues_like_that_map(
    observed_sets: tuple[SparseMap, list[set[int]]],
) -> None:
    original, _ = observed_sets
    original.readout = Readout(0.02, 1e4)
    original.loops.append(Loop(0, 5, EYE))
    restored = make_map()
    restored.load_state_dict(original.state_dict())
    assert restored.keyframes is original.keyframes and restored.landmarks is original.landmarks  # shared, not copied
    restored.load_state_dict(copy.deepcopy(original.state_dict()))
    for sparse_map in (original, restored):
        newest = sparse_map.insert_keyframe(12, 0.4, EYE, features(6, seed=50), unmatched(6))
        sparse_map.fuse_landmarks(newest, torch.tensor([4, -1, 7, -1, -1, 30]))
        cull_keyframes(sparse_map, {3: 0})
        sparse_map.move_keyframes(se3_exp(torch.full((6,), 0.1, dtype=torch.float64)) @ sparse_map.T_cw)
        sparse_map.set_readout(Readout(0.03, 1e4))
    assert restored.keyframes is not original.keyframes and len(restored.keyframes) == 13 and len(restored.loops) == 1
    assert_equal_tables(original, restored)


@given(st.lists(st.integers(0, 30), max_size=40))
def test_unique_ids_equal_torch_unique(numbers: list[int]) -> None:
    ids = torch.tensor(numbers, dtype=torch.int64)
    for ours, expected in zip(unique_ids(ids, 31), ids.unique(return_inverse=True), strict=True):
        assert torch.equal(ours, expected)
