"""Place recognition: scores against a plain count, real and made-up places, determinism."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import faiss
import kornia_rs
import numpy as np
import pytest
import torch
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase


def descriptors(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8)


def seen_again(known: Tensor, flip: float, seed: int) -> Tensor:
    """Descriptors with each bit flipped with probability ``flip``."""
    bits = np.random.default_rng(seed).random((known.shape[0], 256)) < flip
    return known ^ torch.from_numpy(np.packbits(bits, axis=1))


def plain_scores(query: Tensor, keyframes: list[Tensor]) -> list[float]:
    scores = [0.0] * len(keyframes)
    for descriptor in query.numpy():
        voted = []
        for k, keyframe in enumerate(keyframes):
            same_bucket = (keyframe.numpy()[:, :2] == descriptor[:2]).all(axis=1)
            distance = np.unpackbits(keyframe.numpy() ^ descriptor, axis=1).sum(axis=1)
            if (same_bucket & (distance < 50)).any():
                voted.append(k)
        for k in voted:
            scores[k] += math.log(1 + len(keyframes) / len(voted)) / query.shape[0]
    return scores


def test_scores_equal_a_plain_count() -> None:
    common = descriptors(30, seed=99)
    keyframes = [torch.cat([descriptors(60, seed=k), seen_again(common, 0.02, seed=k)]) for k in range(6)]
    index = KeyframeDatabase()
    for k, keyframe in enumerate(keyframes):
        index.add(10 * k, keyframe)
    query = torch.cat([seen_again(keyframes[3], 0.03, seed=7), seen_again(keyframes[1][:20], 0.03, seed=8)])
    expected = plain_scores(query, keyframes)
    found = dict(index.query(query, k=6))
    assert {k: found.get(10 * k, 0.0) for k in range(6)} == pytest.approx(dict(enumerate(expected)))
    assert max(found, key=lambda k: found[k]) == 30


def test_the_place_comes_first() -> None:
    index = KeyframeDatabase()
    keyframes = [descriptors(300, seed=k) for k in range(50)]
    for k, keyframe in enumerate(keyframes):
        index.add(k, keyframe)
    for k in range(0, 50, 7):
        (best, score), *rest = index.query(seen_again(keyframes[k][:150], 0.05, seed=k), k=3)
        assert best == k
        assert all(score > 5 * other for _, other in rest)


def test_excluded_keyframes_do_not_come() -> None:
    place = descriptors(200, seed=0)
    index = KeyframeDatabase()
    for k in range(5):
        index.add(k, seen_again(place, 0.02, seed=k))
    found = [k for k, _ in index.query(place, k=5, exclude=[1, 4, 77])]
    assert sorted(found) == [0, 2, 3]
    assert index.query(place, k=5, exclude=range(5)) == []


def test_what_all_keyframes_show_decides_nothing() -> None:
    index = KeyframeDatabase()
    everywhere = descriptors(100, seed=0)
    for k in range(10):
        index.add(k, torch.cat([everywhere, descriptors(20, seed=1 + k)]))
    # fewer descriptors, but those that only keyframe 6 has
    query = torch.cat([everywhere, descriptors(20, seed=7)])
    assert index.query(query, k=1)[0][0] == 6


def test_nothing_known_nothing_seen() -> None:
    index = KeyframeDatabase()
    assert index.query(descriptors(10, seed=0), k=3) == []
    index.add(0, descriptors(0, seed=0))
    assert index.query(descriptors(10, seed=0), k=3) == []
    index.add(1, descriptors(10, seed=0))
    assert index.query(descriptors(0, seed=0), k=3) == []
    assert [k for k, _ in index.query(descriptors(10, seed=0), k=3)] == [1]
    assert len(index) == 2


def test_same_answer_with_any_number_of_threads() -> None:
    place = descriptors(300, seed=0)
    answers = []
    threads = faiss.omp_get_max_threads()
    for count in (1, 4):
        faiss.omp_set_num_threads(count)
        index = KeyframeDatabase()
        for k in range(20):
            index.add(k, seen_again(place, 0.01 * k, seed=k))
        answers.append(index.query(place, k=10))
    faiss.omp_set_num_threads(threads)
    assert answers[0] == answers[1]


def test_equal_scores_oldest_first() -> None:
    place = descriptors(50, seed=0)
    index = KeyframeDatabase()
    for k in (8, 3, 5):
        index.add(k, place)
    assert [k for k, _ in index.query(place, k=3)] == [8, 3, 5]


def test_real_places(v3d_data: Path) -> None:
    """The camera turns on the spot (fr1_rpy): views that face the same way show the same place."""
    root = v3d_data / "fr1_rpy"
    if not root.is_dir():
        pytest.skip(f"{root} is not there")
    rows = [line.split() for line in (root / "associations.txt").read_text(encoding="utf-8").splitlines()][::20]
    truth = np.loadtxt(root / "groundtruth.txt")
    index = KeyframeDatabase()
    views, forward = [], []
    for k, (stamp, colour, *_) in enumerate(rows):
        image = cv2.cvtColor(cv2.imread(str(root / colour)), cv2.COLOR_BGR2RGB)
        found = kornia_rs.features.orb_detect_and_compute(image, n_keypoints=1000)
        views.append(torch.from_numpy(found.descriptors.copy()))
        pose = truth[np.abs(truth[:, 0] - float(stamp)).argmin()]
        x, y, z, w = pose[4:]
        forward.append([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        index.add(k, views[-1])
    cosine = np.array(forward) @ np.array(forward).T
    number = np.arange(len(rows))
    apart = np.abs(number[:, None] - number) > 3
    same, other = apart & (cosine > math.cos(math.radians(15))), apart & (cosine < math.cos(math.radians(60)))
    hits, asked = 0, 0
    for k in number[same.any(axis=1)].tolist():
        candidates = [c for c, _ in index.query(views[k], k=3, exclude=range(k - 3, k + 4))]
        hits += bool(same[k, candidates].any())
        asked += 1
        assert not other[k, candidates[0]]
    assert asked >= 20
    assert hits / asked >= 0.85
