"""Loops in made-up rooms: a camera walks around twice, its poses drift, and what it sees again puts them right."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase
from v3d_torch.backend.loop_closer import LoopCloser
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.motion_estimator import MotionEstimator
from v3d_torch.tracking.map_tracker import MapTracker

CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5)
LAP = 24
"""Keyframes of one way around."""
OPEN = 19
"""Keyframes until a place of the first one comes back into view."""
DRIFT = torch.tensor([0.002, 0.005, 0.002, 0.0005, 0.002, 0.0005], dtype=torch.float64)
"""Error of the motion between two keyframes 0.26 m apart, metres and radians."""


class Room:
    """Points on the walls of a room of 5 x 5 x 2.6 m, each with its descriptor."""

    def __init__(self, seed: int, count: int = 3000) -> None:
        generator = torch.Generator().manual_seed(seed)
        place = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
        wall = torch.randint(0, 4, (count,), generator=generator)
        axis = torch.tensor([0, 0, 2, 2])[wall]
        place[torch.arange(count), axis] = torch.tensor([-0.5, 0.5, -0.5, 0.5], dtype=torch.float64)[wall]
        self.points = place * torch.tensor([5.0, 2.6, 5.0])
        self.descriptors = torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8)

    def look(self, T_wc: Tensor, seed: int) -> tuple[Features, Tensor]:
        """Features from a pose, with noise on pixels, depth and bits, and the points behind them."""
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        T_cw = invert(T_wc)
        points = self.points @ T_cw[:3, :3].T + T_cw[:3, 3]
        uv = CAMERA.project(torch.where(points[:, 2:] > 0.5, points, -1.0))
        seen = ((uv >= 0) & (uv < torch.tensor([640, 480]))).all(dim=1) & (points[:, 2] > 0.5)
        distance = points[seen].norm(dim=1)
        octave = (torch.log(6.0 / distance) / math.log(1.2)).round().clamp(0, 7).long()
        z = points[seen, 2]
        flipped = torch.rand(len(z), 32, 8, generator=generator) < 0.02
        flips = (flipped * 2 ** torch.arange(8)).sum(dim=-1).to(torch.uint8)
        uv = uv[seen] + 0.3 * normal(len(z), 2)
        features = Features(
            uv=uv,
            pixel=uv.round().long().clamp(min=0).minimum(torch.tensor([639, 479])),
            depth=z + 0.002 * z**2 * normal(len(z)),
            octave=octave,
            descriptors=self.descriptors[seen] ^ flips,
        )
        return features, torch.nonzero(seen)[:, 0]


def on_the_way(k: int) -> Tensor:
    """``T_wc`` of a camera on a circle of 1 m radius that looks outward, as keyframe ``k`` of a lap."""
    turn = torch.tensor([0, 0, 0, 0, 2 * math.pi * k / LAP, 0], dtype=torch.float64)
    out = torch.tensor([0, 0, 1, 0, 0, 0], dtype=torch.float64)
    return se3_exp(turn) @ se3_exp(out)


class Walker:
    """Makes keyframes from drifting poses, and remembers landmarks as long as the last three keyframes saw them."""

    def __init__(self, *overrides: str) -> None:
        config = load_config(overrides=list(overrides))
        self.map = SparseMap(config.mapping, config.features, CAMERA)
        self.closer = closer(config)
        self.true: list[Tensor] = []
        self.corrections: list[Tensor | None] = []
        self._seen: list[Tensor] = []  # the points behind each keyframe's features
        self._since = 0  # first keyframe of which landmarks are remembered

    def step(
        self, room: Room, T_wc: Tensor, *, disconnected: bool = False, guess: Tensor | None = None, every: int = 1
    ) -> Keyframe:
        """Go to a pose, by a motion that is wrong by the drift, and make a keyframe there.

        A guess that is wrong instead joins the pose of a camera that was lost; it has no landmark in view any more.
        """
        if guess is not None:
            self._since = len(self.true)
        if self.true:
            motion = invert(self.true[-1]) @ T_wc @ se3_exp(DRIFT if guess is None else guess)
            T_cw = invert(invert(self.map.keyframes[-1].T_cw) @ motion)
        else:
            T_cw = invert(T_wc)
        features, which = room.look(T_wc, seed=len(self.true))
        features, which = features[torch.arange(0, len(which), every)], which[::every]
        known = torch.full((len(room.points),), -1)
        since = max(self._since, len(self._seen) - 3)
        for points, recent in list(zip(self._seen, self.map.keyframes, strict=True))[since:]:
            known[points] = torch.maximum(known[points], recent.landmarks)
        keyframe = self.map.insert_keyframe(len(self.true), len(self.true) / 3, T_cw, features, known[which])
        keyframe.disconnected = disconnected
        self.true.append(T_wc)
        closure = self.closer.detect_loop(keyframe, self.map, self.map.T_cw)
        self.corrections.append(None if closure is None else self.closer.correct_loop(closure, self.map))
        self.closer.add_keyframe(keyframe)
        self._seen.append(which)
        return keyframe

    def errors(self) -> Tensor:
        """Distance of each keyframe to its true place, metres; the first is the world, nothing is aligned."""
        T_cw = torch.stack([keyframe.T_cw for keyframe in self.map.keyframes])
        return (invert(T_cw) - torch.stack(self.true))[:, :3, 3].norm(dim=1)

    def length(self) -> float:
        """Of the true way, metres."""
        return float(torch.stack(self.true)[:, :3, 3].diff(dim=0).norm(dim=1).sum())


def closer(config: Config) -> LoopCloser:
    motion = MotionEstimator(config.odometry, config.features, CAMERA, config.seed)
    tracker = MapTracker(config.tracking, config.features, CAMERA)
    return LoopCloser(config.loop, motion, tracker, config.tracking.local_keyframes)


def walk_twice(*overrides: str) -> Walker:
    walker, room = Walker(*overrides), Room(seed=1)
    for k in range(2 * LAP):
        walker.step(room, on_the_way(k))
    return walker


@pytest.fixture(scope="module")
def closed() -> Walker:
    return walk_twice()


@pytest.fixture(scope="module")
def drifted() -> Walker:
    return walk_twice("loop.enabled=false")


def rmse(errors: Tensor) -> float:
    return float(errors.square().mean().sqrt())


def test_a_loop_takes_the_drift_away(closed: Walker, drifted: Walker) -> None:
    assert drifted.closer.loop_count == 0
    assert rmse(drifted.errors()) > 0.01 * drifted.length()
    assert closed.closer.loop_count > 0
    assert rmse(closed.errors()) < 0.005 * closed.length()
    assert rmse(closed.errors()) < 0.3 * rmse(drifted.errors())


def test_the_loop_is_found_as_soon_as_a_place_comes_back(closed: Walker) -> None:
    first = next(k for k, correction in enumerate(closed.corrections) if correction is not None)
    assert LAP - 3 <= first <= LAP + 1


def test_the_same_landmarks_are_seen_on_both_laps(closed: Walker, drifted: Walker) -> None:
    first = next(k for k, correction in enumerate(closed.corrections) if correction is not None)

    def joint(walker: Walker) -> int:
        landmarks = walker.map.keyframes[first + 1].landmarks
        return int(walker.map.count_shared(landmarks[landmarks >= 0])[: LAP // 2].sum())

    assert joint(drifted) == 0
    assert joint(closed) > 100


def test_landmarks_move_with_their_keyframes() -> None:
    """After the correction, what the map says a keyframe should see is where the keyframe saw it."""
    walker, room = Walker(), Room(seed=1)
    while not any(correction is not None for correction in walker.corrections):
        walker.step(room, on_the_way(len(walker.true)))
    table, landmarks = walker.map.observations, walker.map.landmarks
    T_cw = torch.stack([keyframe.T_cw for keyframe in walker.map.keyframes])[table["keyframe"]]
    points = (T_cw[:, :3, :3] @ landmarks["point"][table["landmark"], :, None])[..., 0] + T_cw[:, :3, 3]
    own = landmarks["keyframe"][table["landmark"]] == table["keyframe"]
    error = (CAMERA.project(points) - table["uv"]).norm(dim=1)
    assert own.sum() > 1000
    assert error[own].max() < 1e-6


def test_convention_the_correction_maps_the_old_world_to_the_new() -> None:
    walker, room = Walker(), Room(seed=1)
    # The same walk without the correction tells where the newest keyframe was before.
    twin = Walker("loop.enabled=false")
    while not any(correction is not None for correction in walker.corrections):
        k = len(walker.true)
        walker.step(room, on_the_way(k))
        twin.step(room, on_the_way(k))
    T_new_old = walker.corrections[-1]
    assert T_new_old is not None
    old, new = invert(twin.map.keyframes[-1].T_cw), invert(walker.map.keyframes[-1].T_cw)
    torch.testing.assert_close(T_new_old @ old, new, rtol=0, atol=1e-9)
    assert (old[:3, 3] - new[:3, 3]).norm() > 0.05


def test_a_place_that_shows_little_of_what_it_should_is_no_loop() -> None:
    """On the second lap something covers eleven of twelve features; without the rule the rest makes a loop."""
    found = {}
    for overrides in ((), ("loop.min_inlier_ratio=0",)):
        walker, room = Walker("loop.min_inliers=15", *overrides), Room(seed=1)
        for k in range(OPEN):
            walker.step(room, on_the_way(k))
        assert walker.closer.loop_count == 0
        while len(walker.true) < LAP + OPEN - 1:  # until places come back that were covered, too
            walker.step(room, on_the_way(len(walker.true)), every=12)
        found[overrides] = walker.closer.loop_count
    assert found[()] == 0 and found[("loop.min_inlier_ratio=0",)] > 0


def test_two_rooms_make_no_loop() -> None:
    walker = Walker()
    for room in (Room(seed=1), Room(seed=2)):
        for k in range(OPEN):
            walker.step(room, on_the_way(k))
    assert walker.closer.loop_count == 0


def test_the_same_posters_on_other_places_make_no_loop() -> None:
    """Descriptors that are all known, but in another arrangement: appearance says yes, geometry no."""
    walker, room = Walker(), Room(seed=1)
    other = Room(seed=2)
    other.descriptors = room.descriptors
    index = KeyframeDatabase()
    for k in range(OPEN):
        index.add(k, walker.step(room, on_the_way(k)).features.descriptors)
    view, _ = other.look(on_the_way(3), seed=99)
    assert index.query(view.descriptors, 1)[0][1] > 0.1  # appearance takes the bait
    assert index.query(Room(seed=3).look(on_the_way(3), seed=99)[0].descriptors, 1) == []
    for k in range(OPEN):
        walker.step(other, on_the_way(k))
    assert walker.closer.loop_count == 0


def test_what_the_map_still_connects_is_no_loop() -> None:
    """To and fro before the same wall for long: the places are known, but nothing has been lost sight of."""
    walker, room = Walker("loop.min_keyframe_gap=3"), Room(seed=1)
    for k in range(20):
        walker.step(room, on_the_way(0) @ se3_exp(torch.tensor([0.05 * (k % 2), 0, 0, 0, 0, 0], dtype=torch.float64)))
    assert walker.closer.loop_count == 0


def test_a_lost_camera_is_found_where_it_is() -> None:
    walker, room = Walker(), Room(seed=1)
    for k in range(10):
        walker.step(room, on_the_way(k))
    # Between two keyframes, a step aside and tilted; in the world as the drifting map has it around keyframe 2.
    aside = se3_exp(torch.tensor([0.15, -0.1, 0.1, 0.05, 0.08, 0.2], dtype=torch.float64))
    features, _ = room.look(on_the_way(2) @ aside, seed=77)
    place = walker.closer.relocalise(features, walker.map)
    assert place is not None
    assert place.keyframe.index in (0, 1, 2, 3, 4)
    assert place.tracking.count > 100
    expected = invert(invert(walker.map.keyframes[2].T_cw) @ aside)
    offset = se3_log(place.tracking.T_cw @ invert(expected)).abs()
    # As exact as the map around it, which drifts by 6 mm a keyframe.
    assert offset[:3].max() < 0.02 and offset[3:].max() < 0.01
    assert walker.closer.relocalise(features, walker.map, exclude=range(10)) is None
    assert walker.closer.relocalise(Room(seed=2).look(on_the_way(2), seed=77)[0], walker.map) is None


def test_too_few_landmarks_are_no_place() -> None:
    walker, room = Walker(), Room(seed=1)
    for k in range(6):
        walker.step(room, on_the_way(k))
    features, _ = room.look(on_the_way(2), seed=77)
    assert walker.closer.relocalise(features[torch.arange(39)], walker.map) is None
    assert walker.closer.relocalise(features[torch.zeros(0, dtype=torch.int64)], walker.map) is None
    without_depth = replace(features, depth=torch.zeros_like(features.depth))
    assert walker.closer.relocalise(without_depth, walker.map) is not None  # the map has depth enough


def test_what_was_disconnected_is_joined_by_the_loop() -> None:
    walker, room = Walker(), Room(seed=1)
    for k in range(OPEN):
        walker.step(room, on_the_way(k), disconnected=k > 12)
    assert walker.closer.loop_count == 0
    assert any(keyframe.disconnected for keyframe in walker.map.keyframes)
    while walker.corrections[-1] is None:
        walker.step(room, on_the_way(len(walker.true)), disconnected=True)
    assert not any(keyframe.disconnected for keyframe in walker.map.keyframes)


def test_the_loop_puts_a_wrong_guess_right_and_bends_nothing_for_it() -> None:
    """A camera that was lost is guessed half a metre from where it is: the loop alone says how the parts lie."""
    walker, room = Walker(), Room(seed=1)
    guess = torch.tensor([0.4, 0, 0.3, 0, 0.35, 0], dtype=torch.float64)
    for k in range(2 * LAP):
        walker.step(room, on_the_way(k), disconnected=k >= 12, guess=guess if k == 12 else None)
        if walker.corrections[-1] is not None:
            break
        if k == 11:
            before = walker.errors()
        if k == 12:
            assert walker.errors()[12] > 0.4
    assert walker.closer.loop_count == 1
    torch.testing.assert_close(walker.errors()[:12], before, rtol=0, atol=1e-3)
    assert walker.errors()[12:].max() < 0.1  # drift from the loop back to keyframe 12


def test_deterministic(closed: Walker) -> None:
    again = walk_twice()
    for first, second in zip(closed.map.keyframes, again.map.keyframes, strict=True):
        assert torch.equal(first.T_cw, second.T_cw)
