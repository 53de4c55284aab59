"""Place recognition: scores against a naive count, synthetic and real places, determinism."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from pathlib import Path

import cv2
import kornia_rs
import numpy as np
import pytest
import torch
from helpers.library_settings import faiss_threads
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase


def descriptors(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8)


def with_bit_errors(known: Tensor, probability: float, seed: int) -> Tensor:
    """Descriptors with each bit flipped at the given probability."""
    bits = np.random.default_rng(seed).random((known.shape[0], 256)) < probability
    return known ^ torch.from_numpy(np.packbits(bits, axis=1))


def naive_scores(query: Tensor, keyframes: list[Tensor]) -> list[float]:
    scores = [0.0] * len(keyframes)
    for descriptor in query.numpy():
        matched = []
        for k, keyframe in enumerate(keyframes):
            same_bucket = (keyframe.numpy()[:, :2] == descriptor[:2]).all(axis=1)
            distance = np.unpackbits(keyframe.numpy() ^ descriptor, axis=1).sum(axis=1)
            if (same_bucket & (distance < 50)).any():
                matched.append(k)
        for k in matched:
            scores[k] += math.log(1 + len(keyframes) / len(matched)) / query.shape[0]
    return scores


def test_scores_equal_a_naive_count() -> None:
    common = descriptors(30, seed=99)
    keyframes = [torch.cat([descriptors(60, seed=k), with_bit_errors(common, 0.02, seed=k)]) for k in range(6)]
    database = KeyframeDatabase()
    for k, keyframe in enumerate(keyframes):
        database.add(10 * k, keyframe)
    query = torch.cat([with_bit_errors(keyframes[3], 0.03, seed=7), with_bit_errors(keyframes[1][:20], 0.03, seed=8)])
    expected = naive_scores(query, keyframes)
    found = dict(database.query(query, k=6))
    assert {k: found.get(10 * k, 0.0) for k in range(6)} == pytest.approx(dict(enumerate(expected)))
    assert max(found, key=lambda k: found[k]) == 30


def test_keyframe_of_the_same_place_ranks_first() -> None:
    database = KeyframeDatabase()
    keyframes = [descriptors(300, seed=k) for k in range(50)]
    for k, keyframe in enumerate(keyframes):
        database.add(k, keyframe)
    for k in range(0, 50, 7):
        (best, score), *rest = database.query(with_bit_errors(keyframes[k][:150], 0.05, seed=k), k=3)
        assert best == k
        assert all(score > 5 * other for _, other in rest)


def test_excluded_keyframes_are_not_returned() -> None:
    place = descriptors(200, seed=0)
    database = KeyframeDatabase()
    for k in range(5):
        database.add(k, with_bit_errors(place, 0.02, seed=k))
    found = [k for k, _ in database.query(place, k=5, exclude=[1, 4, 77])]
    assert sorted(found) == [0, 2, 3]
    assert database.query(place, k=5, exclude=range(5)) == []


def test_descriptors_of_all_keyframes_do_not_decide() -> None:
    database = KeyframeDatabase()
    common = descriptors(100, seed=0)
    for k in range(10):
        database.add(k, torch.cat([common, descriptors(20, seed=1 + k)]))
    # The query has 20 descriptors that only keyframe 6 has.
    query = torch.cat([common, descriptors(20, seed=7)])
    assert database.query(query, k=1)[0][0] == 6


def test_empty_database_and_empty_query_give_no_keyframes() -> None:
    database = KeyframeDatabase()
    assert database.query(descriptors(10, seed=0), k=3) == []
    database.add(0, descriptors(0, seed=0))
    assert database.query(descriptors(10, seed=0), k=3) == []
    database.add(1, descriptors(10, seed=0))
    assert database.query(descriptors(0, seed=0), k=3) == []
    assert [k for k, _ in database.query(descriptors(10, seed=0), k=3)] == [1]
    assert len(database) == 2


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    place = descriptors(300, seed=0)
    results = []
    for count in (1, 4):
        with faiss_threads(count):
            database = KeyframeDatabase()
            for k in range(20):
                database.add(k, with_bit_errors(place, 0.01 * k, seed=k))
            results.append(database.query(place, k=10))
    assert results[0] == results[1]


def test_equal_scores_rank_in_order_of_insertion() -> None:
    place = descriptors(50, seed=0)
    database = KeyframeDatabase()
    for k in (8, 3, 5):
        database.add(k, place)
    assert [k for k, _ in database.query(place, k=3)] == [8, 3, 5]


@pytest.mark.parametrize("removed", [[3], [0, 1], [4, 0, 2], [0, 1, 2, 3, 4]])
def test_removed_keyframes_do_not_influence_the_scores(removed: list[int]) -> None:
    """Scores depend on the number of keyframes and on how many contain a descriptor: removed ones must not count."""
    dice = random.Random(1)  # noqa: S311
    common = descriptors(40, seed=9)
    database, expected = KeyframeDatabase(), KeyframeDatabase()
    for k in range(5):
        keyframe = torch.cat([common[dice.sample(range(40), 25)], descriptors(20, seed=k)])
        database.add(k, keyframe)
        if k not in removed:
            expected.add(k, keyframe)
    database.remove([*removed[:1], 99])
    database.remove(removed)
    assert len(database) == len(expected) == 5 - len(removed)
    assert database.query(common, k=5) == expected.query(common, k=5)
    database.add(7, common)
    expected.add(7, common)
    assert database.query(common, k=5, exclude=[7]) == expected.query(common, k=5, exclude=[7])


def test_real_images_of_the_same_direction_are_recognised(real_sequence: Callable[[str], Path]) -> None:
    """The camera of fr1_rpy rotates on the spot: images in the same direction show the same place."""
    root = real_sequence("fr1_rpy")
    rows = [line.split() for line in (root / "associations.txt").read_text(encoding="utf-8").splitlines()][::20]
    truth = np.loadtxt(root / "groundtruth.txt")
    database = KeyframeDatabase()
    views, forward = [], []
    for k, (stamp, colour, *_) in enumerate(rows):
        image = cv2.cvtColor(cv2.imread(str(root / colour)), cv2.COLOR_BGR2RGB)
        orb = kornia_rs.features.orb_detect_and_compute(image, n_keypoints=1000)
        views.append(torch.from_numpy(orb.descriptors.copy()))
        pose = truth[np.abs(truth[:, 0] - float(stamp)).argmin()]
        x, y, z, w = pose[4:]
        forward.append([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        database.add(k, views[-1])
    cosine = np.array(forward) @ np.array(forward).T
    number = np.arange(len(rows))
    apart = np.abs(number[:, None] - number) > 3
    same, other = apart & (cosine > math.cos(math.radians(15))), apart & (cosine < math.cos(math.radians(60)))
    hits, queries = 0, 0
    for k in number[same.any(axis=1)].tolist():
        candidates = [c for c, _ in database.query(views[k], k=3, exclude=range(k - 3, k + 4))]
        hits += bool(same[k, candidates].any())
        queries += 1
        assert not other[k, candidates[0]]
    assert queries >= 20
    assert hits / queries >= 0.85
