"""Culling of landmarks and keyframes against plain counting; poses of culled keyframes."""

from __future__ import annotations

from itertools import pairwise

import torch
from helpers.sparse_maps import CAMERA, EYE
from helpers.sparse_maps import features as random_features
from helpers.sparse_maps import make_map as make_empty_map
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config, MappingConfig
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.covisibility import count_shared_landmarks, covisibility_edges
from v3d_torch.mapping.culling import cull_keyframes, cull_landmarks, cull_redundant_keyframes
from v3d_torch.mapping.sparse_map import SparseMap

LANDMARKS = 20
LEVELS = Config().features.levels
ALL = dict.fromkeys(range(LANDMARKS), 0)
ALL_COARSER = dict.fromkeys(range(LANDMARKS), 1)

Observed = dict[int, int]
"""Landmarks that a keyframe observes, with the octave of each."""


def pose(seed: int) -> Tensor:
    return se3_exp(torch.randn(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


def insert(sparse_map: SparseMap, observed: Observed, T_cw: Tensor = EYE, new: int = 0) -> None:
    """Insert a keyframe that observes known landmarks, by features without depth, and creates some new ones."""
    count, index = len(observed) + new, len(sparse_map.keyframes)
    generator = torch.Generator().manual_seed(index)
    uv = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor([639, 479])
    features = Features(
        uv=uv,
        pixel=uv.round().long(),
        depth=torch.cat([torch.zeros(len(observed)), torch.full((new,), 2.0)]).double(),
        octave=torch.tensor([*observed.values(), *[0] * new], dtype=torch.int64),
        descriptors=torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8),
    )
    landmarks = torch.tensor([*observed, *[-1] * new], dtype=torch.int64)
    sparse_map.insert_keyframe(index, index / 30, T_cw, features, landmarks)


def make_map(observed: list[Observed], *, moving: bool = False) -> SparseMap:
    """A map whose first keyframe creates all landmarks, and whose other keyframes observe some of them."""
    config = Config()
    sparse_map = SparseMap(config.mapping, config.features, CAMERA)
    insert(sparse_map, {}, new=LANDMARKS)
    for index, by_keyframe in enumerate(observed, start=1):
        insert(sparse_map, by_keyframe, pose(index) if moving else EYE)
    return sparse_map


def cull(sparse_map: SparseMap, **config: float) -> set[int]:
    """Cull redundant keyframes; returns the indices of all culled keyframes."""
    cull_redundant_keyframes(sparse_map, sparse_map.keyframes[-1], MappingConfig(**config))
    return {keyframe.index for keyframe in sparse_map.keyframes if keyframe.is_culled}


def count_redundant(observed: list[Observed], ratio: float, views: int) -> set[int]:
    """ORB-SLAM2's criterion, pair by pair, in the order of shared landmarks with the newest keyframe, newest first."""
    all_observed: dict[int, Observed] = dict(enumerate([dict.fromkeys(range(LANDMARKS), 0), *observed]))
    newest, culled = len(observed), set()
    shared = {index: len(own.keys() & all_observed[newest].keys()) for index, own in all_observed.items()}
    for index in sorted(all_observed, key=lambda index: (-shared[index], -index)):
        if index in (0, newest) or not shared[index]:
            continue
        others = [own for other, own in all_observed.items() if other != index and other not in culled]
        redundant = [
            sum(octave >= other[landmark] - 1 for other in others if landmark in other) >= views
            for landmark, octave in all_observed[index].items()
        ]
        if sum(redundant) > ratio * len(redundant):
            culled.add(index)
    return culled


OBSERVED = st.lists(
    st.dictionaries(st.integers(0, LANDMARKS - 1), st.integers(0, LEVELS - 1), min_size=1), min_size=1, max_size=9
)


@settings(max_examples=80)
@given(OBSERVED, st.sampled_from([0.3, 0.5, 0.9]), st.integers(1, 4))
@example([ALL], 0.9, 1)  # the first keyframe is redundant, and stays
@example([ALL, ALL_COARSER], 0.9, 2)  # a view at the next octave counts
def test_culled_keyframes_equal_a_plain_count(observed: list[Observed], ratio: float, views: int) -> None:
    culled = cull(make_map(observed), redundant_ratio=ratio, redundant_views=views)
    assert culled == count_redundant(observed, ratio, views)


def test_first_and_newest_keyframe_are_kept_and_a_ratio_of_1_keeps_all() -> None:
    identical = [dict.fromkeys(range(LANDMARKS), 0) for _ in range(8)]
    assert cull(make_map(identical), redundant_ratio=1.0) == set()
    kept = set(range(9)) - cull(make_map(identical))
    assert {0, 8} < kept and len(kept) == 3  # each landmark is observed by only 2 others


def test_culled_landmarks_do_not_make_a_keyframe_redundant() -> None:
    """Enough other keyframes observe 15 landmarks of keyframe 1, of which one is left, but not its other five."""
    shared = dict.fromkeys(range(15), 0)
    sparse_map = make_map([ALL, shared, shared, shared])
    sparse_map.landmarks["active"][1:15] = False
    assert 1 not in cull(sparse_map, redundant_ratio=0.5, redundant_views=2)


def test_culling_a_keyframe_removes_its_observations_and_its_own_landmarks_only() -> None:
    """The landmark that no other keyframe observes becomes inactive; other observations stay."""
    sparse_map = make_map([])
    insert(sparse_map, dict.fromkeys(range(1, LANDMARKS), 0), new=1)
    for _ in range(3):
        insert(sparse_map, dict.fromkeys(range(LANDMARKS), 0))
    before = count_shared_landmarks(sparse_map, torch.arange(LANDMARKS + 1))
    cull_keyframes(sparse_map, {1: 2})
    culled, after = sparse_map.keyframes[1], count_shared_landmarks(sparse_map, torch.arange(LANDMARKS + 1))
    assert len(culled.features) == len(culled.landmarks) == after[1] == 0
    assert torch.equal(after[[0, 2, 3, 4]], before[[0, 2, 3, 4]])
    assert torch.nonzero(~sparse_map.landmarks["active"]).tolist() == [[LANDMARKS]]
    assert [keyframe.index for keyframe in sparse_map.active_keyframes] == [0, 2, 3, 4]
    for keyframe in sparse_map.active_keyframes:  # the table agrees with the keyframes
        rows = sparse_map.observations["keyframe"] == keyframe.index
        landmarks = torch.full_like(keyframe.landmarks, -1)
        landmarks[sparse_map.observations["feature"][rows]] = sparse_map.observations["landmark"][rows]
        assert torch.equal(landmarks, keyframe.landmarks)


def test_landmark_that_only_a_culled_keyframe_still_observes_becomes_inactive() -> None:
    """Bundle adjustment has removed its observations by the other keyframes as outliers."""
    sparse_map = make_map([ALL, ALL])
    rows = (sparse_map.observations["landmark"] == 3) & (sparse_map.observations["keyframe"] != 1)
    sparse_map.remove_observations(torch.nonzero(rows)[:, 0])
    cull_keyframes(sparse_map, {1: 2})
    assert torch.nonzero(~sparse_map.landmarks["active"]).tolist() == [[3]]


def test_culled_keyframes_and_their_landmarks_move_with_the_reference_keyframe() -> None:
    """Also if the reference keyframe is culled later: 1 moves with 2, then 2 with 4."""
    sparse_map = make_map([dict.fromkeys(range(LANDMARKS), 0) for _ in range(4)], moving=True)
    sparse_map.landmarks["keyframe"][:5] = 1
    for references in ({1: 2}, {2: 4}):
        cull_keyframes(sparse_map, references)
        before, points = sparse_map.T_cw, sparse_map.landmarks["point"].clone()
        moved = torch.stack([pose(100 + index) for index in range(5)])
        sparse_map.move_keyframes(moved)
        after = sparse_map.T_cw
        assert torch.equal(after[[3, 4]], moved[[3, 4]])
        for index in range(5):
            reference = sparse_map.keyframes[index].reference
            relative = before[index] @ invert(before[reference])
            torch.testing.assert_close(after[index] @ invert(after[reference]), relative, rtol=0, atol=1e-12)
        T_new_old = invert(after[1]) @ before[1]
        expected = points[:5] @ T_new_old[:3, :3].T + T_new_old[:3, 3]
        torch.testing.assert_close(sparse_map.landmarks["point"][:5], expected, rtol=0, atol=1e-9)
    assert [keyframe.reference for keyframe in sparse_map.keyframes] == [0, 4, 4, 3, 4]


def test_reference_of_a_culled_keyframe_is_active_if_both_are_culled_at_once() -> None:
    """Keyframe 2 moves with 1, which observes all of its landmarks, but 1 is culled next and moves with 0."""
    sparse_map = make_map([dict.fromkeys(range(count), 0) for count in (12, 10, 5)])
    assert cull(sparse_map, redundant_views=1) == {1, 2}
    assert [keyframe.reference for keyframe in sparse_map.keyframes] == [0, 0, 0, 3]


def test_reference_of_a_culled_keyframe_is_the_newest_of_those_that_share_most_landmarks() -> None:
    sparse_map = make_map([ALL] * 4)
    assert cull(sparse_map, redundant_views=3) == {2, 3}
    assert [keyframe.reference for keyframe in sparse_map.keyframes] == [0, 1, 4, 4, 4]


def test_consecutive_active_keyframes_are_connected_across_culled_ones() -> None:
    sparse_map = make_map([dict.fromkeys(range(LANDMARKS), 0) for _ in range(5)])
    cull_keyframes(sparse_map, {1: 0, 2: 0, 4: 5})
    assert covisibility_edges(sparse_map, LANDMARKS + 1).tolist() == [list(pair) for pair in pairwise([0, 3, 5])]


# --- landmarks


def test_landmarks_with_a_low_found_ratio_are_culled_after_the_next_keyframe() -> None:
    sparse_map = make_empty_map()
    sparse_map.insert_keyframe(0, 0.0, EYE, random_features(4), torch.full((4,), -1))
    for turn in range(8):  # landmark 0 is found in every frame, 1 in every second frame, 2 once, 3 never
        found = torch.tensor([0, 1 if turn % 2 else -1, 2 if turn == 0 else -1, -1])
        sparse_map.count_matches(found[found >= 0], torch.arange(4))
    cull_landmarks(sparse_map)
    assert sparse_map.landmarks["active"].all()
    insert(sparse_map, dict.fromkeys(range(4), 0))
    cull_landmarks(sparse_map)
    assert sparse_map.landmarks["active"].tolist() == [True, True, False, False]


def test_landmark_that_a_quarter_of_the_frames_match_is_not_culled() -> None:
    sparse_map = make_empty_map()
    sparse_map.insert_keyframe(0, 0.0, EYE, random_features(2), torch.full((2,), -1))
    for found in ([0, 1], [0], [0], [0], [0], [0], [0]):  # with the keyframe, landmark 1 is found in 2 of 8 frames
        sparse_map.count_matches(torch.tensor(found), torch.arange(2))
    insert(sparse_map, {0: 0, 1: 0})
    cull_landmarks(sparse_map)
    assert sparse_map.landmarks["active"].all()


def test_landmarks_without_a_second_observation_are_culled_after_three_keyframes() -> None:
    sparse_map = make_empty_map()
    sparse_map.insert_keyframe(0, 0.0, EYE, random_features(3), torch.full((3,), -1))
    for observed in ({1: 0, 2: 0}, {1: 0}):
        insert(sparse_map, observed)
        cull_landmarks(sparse_map)
    assert sparse_map.landmarks["active"].all()
    insert(sparse_map, {})
    cull_landmarks(sparse_map)
    assert sparse_map.landmarks["active"].tolist() == [False, True, True]
    sparse_map.remove_observations(torch.nonzero(sparse_map.observations["keyframe"] > 0)[:, 0])
    insert(sparse_map, {})
    cull_landmarks(sparse_map)
    assert sparse_map.landmarks["active"][1]  # it was confirmed
