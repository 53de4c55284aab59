"""Keyframes that the map does without: which, against plain counting; and that all that hangs on them follows."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase
from v3d_torch.config import Config, MappingConfig
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.culling import cull_redundant_keyframes
from v3d_torch.mapping.sparse_map import SparseMap

CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5)
EYE = torch.eye(4, dtype=torch.float64)
LANDMARKS = 20
LEVELS = Config().features.levels

Sight = dict[int, int]  # landmarks that a keyframe sees, and on which level of scale each


def pose(seed: int) -> Tensor:
    return se3_exp(torch.randn(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


def insert(target: SparseMap, sight: Sight, T_cw: Tensor = EYE, fresh: int = 0) -> None:
    """A keyframe that sees known landmarks, whose features have no depth, and some new ones."""
    count, index = len(sight) + fresh, len(target.keyframes)
    generator = torch.Generator().manual_seed(index)
    uv = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor([639, 479])
    features = Features(
        uv=uv,
        pixel=uv.round().long(),
        depth=torch.cat([torch.zeros(len(sight)), torch.full((fresh,), 2.0)]).double(),
        octave=torch.tensor([*sight.values(), *[0] * fresh], dtype=torch.int64),
        descriptors=torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8),
    )
    target.insert_keyframe(index, index / 30, T_cw, features, torch.tensor([*sight, *[-1] * fresh], dtype=torch.int64))


def map_of(sights: list[Sight], *, moving: bool = False) -> SparseMap:
    """A map whose first keyframe makes all landmarks, and others that see some of them."""
    config = Config()
    target = SparseMap(config.mapping, config.features, CAMERA)
    insert(target, {}, fresh=LANDMARKS)
    for index, sight in enumerate(sights, start=1):
        insert(target, sight, pose(index) if moving else EYE)
    return target


def cull(target: SparseMap, **config: float) -> set[int]:
    """Indices of those retired by then."""
    cull_redundant_keyframes(target, target.keyframes[-1], MappingConfig(**config))
    return {keyframe.index for keyframe in target.keyframes if keyframe.is_culled}


def counted(sights: list[Sight], share: float, views: int) -> set[int]:
    """ORB-SLAM2's rule, pair by pair: those that share most with the newest first, of these the newest."""
    seen: dict[int, Sight] = dict(enumerate([dict.fromkeys(range(LANDMARKS), 0), *sights]))
    newest, gone = len(sights), set()
    shared = {index: len(sight.keys() & seen[newest].keys()) for index, sight in seen.items()}
    for index in sorted(seen, key=lambda index: (-shared[index], -index)):
        if index in (0, newest) or not shared[index]:
            continue
        others = [sight for other, sight in seen.items() if other != index and other not in gone]
        redundant = [
            sum(level >= other[landmark] - 1 for other in others if landmark in other) >= views
            for landmark, level in seen[index].items()
        ]
        if sum(redundant) > share * len(redundant):
            gone.add(index)
    return gone


SIGHTS = st.lists(
    st.dictionaries(st.integers(0, LANDMARKS - 1), st.integers(0, LEVELS - 1), min_size=1), min_size=1, max_size=9
)


@settings(deadline=None, max_examples=200)
@given(SIGHTS, st.sampled_from([0.3, 0.5, 0.9]), st.integers(1, 4))
def test_those_retired_are_those_of_a_plain_count(sights: list[Sight], share: float, views: int) -> None:
    assert cull(map_of(sights), redundant_share=share, redundant_views=views) == counted(sights, share, views)


def test_neither_the_first_nor_the_newest_goes_and_with_a_share_of_1_nobody() -> None:
    all_alike = [dict.fromkeys(range(LANDMARKS), 0) for _ in range(8)]
    assert cull(map_of(all_alike), redundant_share=1.0) == set()
    kept = set(range(9)) - cull(map_of(all_alike))
    assert {0, 8} < kept and len(kept) == 3  # each is seen by 2 others only


def test_what_a_retired_keyframe_saw_is_forgotten_and_nothing_else() -> None:
    """Landmark 0 is seen by nobody else: it goes; the others stay, and who sees them."""
    target = map_of([])
    insert(target, dict.fromkeys(range(1, LANDMARKS), 0), fresh=1)
    for _ in range(3):
        insert(target, dict.fromkeys(range(LANDMARKS), 0))
    before = target.count_shared(torch.arange(LANDMARKS + 1))
    target.cull_keyframes({1: 2})
    retired, after = target.keyframes[1], target.count_shared(torch.arange(LANDMARKS + 1))
    assert len(retired.features) == len(retired.landmarks) == after[1] == 0
    assert torch.equal(after[[0, 2, 3, 4]], before[[0, 2, 3, 4]])
    assert torch.nonzero(~target.landmarks["alive"]).tolist() == [[LANDMARKS]]
    assert [keyframe.index for keyframe in target.active_keyframes] == [0, 2, 3, 4]
    for keyframe in target.active_keyframes:  # the tables agree with the keyframes
        rows = target.observations["keyframe"] == keyframe.index
        seen = torch.full_like(keyframe.landmarks, -1)
        seen[target.observations["feature"][rows]] = target.observations["landmark"][rows]
        assert torch.equal(seen, keyframe.landmarks)


def test_poses_and_landmarks_of_the_retired_go_along_with_those_kept() -> None:
    """Also where the one that they went along with goes itself: 1 with 2, then 2 with 4."""
    target = map_of([dict.fromkeys(range(LANDMARKS), 0) for _ in range(4)], moving=True)
    target.landmarks["keyframe"][:5] = 1
    for references in ({1: 2}, {2: 4}):
        target.cull_keyframes(references)
        before, points = target.T_cw, target.landmarks["point"].clone()
        moved = torch.stack([pose(100 + index) for index in range(5)])
        target.move_keyframes(moved)
        after = target.T_cw
        assert torch.equal(after[[3, 4]], moved[[3, 4]])
        for index in range(5):
            reference = target.keyframes[index].reference
            kept = before[index] @ invert(before[reference])
            torch.testing.assert_close(after[index] @ invert(after[reference]), kept, rtol=0, atol=1e-12)
        T_new_old = invert(after[1]) @ before[1]
        expected = points[:5] @ T_new_old[:3, :3].T + T_new_old[:3, 3]
        torch.testing.assert_close(target.landmarks["point"][:5], expected, rtol=0, atol=1e-9)
    assert [keyframe.reference for keyframe in target.keyframes] == [0, 4, 4, 3, 4]


def test_neighbours_in_time_are_joined_over_the_retired() -> None:
    target = map_of([dict.fromkeys(range(LANDMARKS), 0) for _ in range(5)])
    target.cull_keyframes({1: 0, 2: 0, 4: 5})
    assert target.covisibility_edges(LANDMARKS + 1).tolist() == [list(pair) for pair in pairwise([0, 3, 5])]


@pytest.mark.parametrize("gone", [[3], [0, 1], [4, 0, 2], [0, 1, 2, 3, 4]])
def test_a_forgotten_place_was_never_there(gone: list[int]) -> None:
    """Scores weigh by how many keyframes there are and show a thing: those forgotten must not count, at once."""
    dice = random.Random(1)  # noqa: S311
    common = torch.randint(0, 256, (40, 32), generator=torch.Generator().manual_seed(9), dtype=torch.uint8)
    places = {
        index: torch.cat([common[dice.sample(range(40), 25)], torch.randint(0, 256, (20, 32), dtype=torch.uint8)])
        for index in range(5)
    }
    index, expected = KeyframeDatabase(), KeyframeDatabase()
    for place, descriptors in places.items():
        index.add(place, descriptors)
        if place not in gone:
            expected.add(place, descriptors)
    index.remove([*gone[:1], 99])
    index.remove(gone)
    assert len(index) == len(expected) == 5 - len(gone)
    assert index.query(common, k=5) == expected.query(common, k=5)
    index.add(7, common)
    expected.add(7, common)
    assert index.query(common, k=5, exclude=[7]) == expected.query(common, k=5, exclude=[7])
