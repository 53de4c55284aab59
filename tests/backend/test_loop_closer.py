"""Loop closing in synthetic rooms: the camera makes two laps with drift, and recognised places correct its poses."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.random_numbers import RandomNumbers
from helpers.waiting import steps_until
from torch import Tensor

from v3d_torch.backend.keyframe_database import KeyframeDatabase
from v3d_torch.backend.loop_closer import LoopCloser, LoopCorrection
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.covisibility import count_shared_landmarks
from v3d_torch.mapping.culling import cull_keyframes
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.motion_estimator import MotionEstimator
from v3d_torch.tracking.map_tracker import MapTracker, MapTracking

CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5)
LAP = 24
"""Keyframes of one lap."""
BEFORE_LOOP = 19
"""Keyframes until a place of the first keyframe is visible again."""
DRIFT = torch.tensor([0.002, 0.005, 0.002, 0.0005, 0.002, 0.0005], dtype=torch.float64)
"""Error of the motion between two keyframes, which are 0.26 m apart: translation in metres, rotation in radians."""

WRONG_GUESS = torch.tensor([0.4, 0, 0.3, 0, 0.35, 0], dtype=torch.float64)
"""Error of the guessed motion of a lost camera: translation in metres, rotation in radians."""


class Room:
    """Points on the walls of a room of 5 x 5 x 2.6 m, each with a random descriptor."""

    def __init__(self, seed: int, count: int = 3000) -> None:
        generator = torch.Generator().manual_seed(seed)
        place = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
        wall = torch.randint(0, 4, (count,), generator=generator)
        axis = torch.tensor([0, 0, 2, 2])[wall]
        place[torch.arange(count), axis] = torch.tensor([-0.5, 0.5, -0.5, 0.5], dtype=torch.float64)[wall]
        self.points = place * torch.tensor([5.0, 2.6, 5.0])
        self.descriptors = torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8)

    def observe(self, T_wc: Tensor, seed: int) -> tuple[Features, Tensor]:
        """Features observed from a pose, with noise on pixels, depth and bits, and the indices of their points."""
        random = RandomNumbers(seed)
        T_cw = invert(T_wc)
        points = self.points @ T_cw[:3, :3].T + T_cw[:3, 3]
        uv = CAMERA.project(torch.where(points[:, 2:] > 0.5, points, -1.0))
        visible = ((uv >= 0) & (uv < torch.tensor([640, 480]))).all(dim=1) & (points[:, 2] > 0.5)
        distance = points[visible].norm(dim=1)
        octave = (torch.log(6.0 / distance) / math.log(1.2)).round().clamp(0, 7).long()
        z = points[visible, 2]
        flipped = torch.rand(len(z), 32, 8, generator=random.generator) < 0.02
        flips = (flipped * 2 ** torch.arange(8)).sum(dim=-1).to(torch.uint8)
        uv = uv[visible] + 0.3 * random.normal(len(z), 2)
        features = Features(
            uv=uv,
            pixel=uv.round().long().clamp(min=0).minimum(torch.tensor([639, 479])),
            depth=z + 0.002 * z**2 * random.normal(len(z)),
            octave=octave,
            descriptors=self.descriptors[visible] ^ flips,
        )
        return features, torch.nonzero(visible)[:, 0]


def lap_pose(k: int) -> Tensor:
    """Pose ``T_wc`` of keyframe ``k``, on a circle of 1 m radius, facing outwards."""
    turn = torch.tensor([0, 0, 0, 0, 2 * math.pi * k / LAP, 0], dtype=torch.float64)
    out = torch.tensor([0, 0, 1, 0, 0, 0], dtype=torch.float64)
    return se3_exp(turn) @ se3_exp(out)


class Camera:
    """Camera that inserts keyframes at drifting poses and tracks landmarks of the last three keyframes."""

    def __init__(self, *overrides: str) -> None:
        config = load_config(overrides=list(overrides))
        self.map = SparseMap(config.mapping, config.features, CAMERA)
        self.loop_closer = make_loop_closer(config)
        self.true_poses: list[Tensor] = []
        self.corrections: list[Tensor | None] = []
        self._points: list[Tensor] = []  # for each keyframe, the indices of the points of its features
        self._first_tracked = 0  # first keyframe of which landmarks are tracked

    def step(self, room: Room, T_wc: Tensor, *, part: int = 0, guess: Tensor | None = None, every: int = 1) -> Keyframe:
        """Move to a pose, with drift in the estimated motion, and insert a keyframe there.

        Args:
            room: Room that the camera observes.
            T_wc: True pose of the keyframe.
            part: Part of the map to which the keyframe belongs.
            guess: Error of the estimated motion in place of the drift, for a camera that was lost and tracks no
                landmarks; None if the camera was not lost.
            every: Use every n-th feature.
        """
        if guess is not None:
            self._first_tracked = len(self.true_poses)
        if self.true_poses:
            motion = invert(self.true_poses[-1]) @ T_wc @ se3_exp(DRIFT if guess is None else guess)
            T_cw = invert(invert(self.map.keyframes[-1].T_cw) @ motion)
        else:
            T_cw = invert(T_wc)
        features, points = room.observe(T_wc, seed=len(self.true_poses))
        features, points = features[torch.arange(0, len(points), every)], points[::every]
        known = torch.full((len(room.points),), -1)
        first = max(self._first_tracked, len(self._points) - 3)
        for recent_points, recent in list(zip(self._points, self.map.keyframes, strict=True))[first:]:
            known[recent_points] = torch.maximum(known[recent_points], recent.landmarks)
        keyframe = self.map.insert_keyframe(
            len(self.true_poses), len(self.true_poses) / 3, T_cw, features, known[points]
        )
        keyframe.part = part
        self.true_poses.append(T_wc)
        correction = self.loop_closer.detect_loop(keyframe, self.map, self.map.T_cw)
        self.corrections.append(None if correction is None else self.loop_closer.correct_loop(correction, self.map))
        self.loop_closer.add_keyframe(keyframe)
        self._points.append(points)
        return keyframe

    def errors(self) -> Tensor:
        """Distance of each keyframe to its true position, metres, without alignment."""
        T_cw = torch.stack([keyframe.T_cw for keyframe in self.map.keyframes])
        return (invert(T_cw) - torch.stack(self.true_poses))[:, :3, 3].norm(dim=1)

    def length(self) -> float:
        """Length of the true path, metres."""
        return float(torch.stack(self.true_poses)[:, :3, 3].diff(dim=0).norm(dim=1).sum())


def make_loop_closer(config: Config, tracker_type: type[MapTracker] = MapTracker) -> LoopCloser:
    motion = MotionEstimator(config.odometry, config.features, CAMERA, config.seed)
    tracker = tracker_type(config.tracking, config.features, CAMERA)
    return LoopCloser(config.loop, motion, tracker, config.tracking.local_keyframes)


def make_two_laps(*overrides: str) -> Camera:
    camera, room = Camera(*overrides), Room(seed=1)
    for k in range(2 * LAP):
        camera.step(room, lap_pose(k))
    return camera


@pytest.fixture(scope="module")
def closed() -> Camera:
    return make_two_laps()


@pytest.fixture(scope="module")
def drifted() -> Camera:
    return make_two_laps("loop.enabled=false")


def rmse(errors: Tensor) -> float:
    return float(errors.square().mean().sqrt())


def test_loop_correction_removes_drift(closed: Camera, drifted: Camera) -> None:
    assert drifted.loop_closer.loop_count == 0
    assert rmse(drifted.errors()) > 0.01 * drifted.length()
    assert closed.loop_closer.loop_count > 0
    assert rmse(closed.errors()) < 0.005 * closed.length()
    assert rmse(closed.errors()) < 0.3 * rmse(drifted.errors())


def test_loop_is_detected_as_soon_as_a_place_is_visible_again(closed: Camera) -> None:
    first = next(k for k, correction in enumerate(closed.corrections) if correction is not None)
    assert LAP - 3 <= first <= LAP + 1


def test_loop_correction_fuses_the_landmarks_of_both_laps(closed: Camera, drifted: Camera) -> None:
    first = next(k for k, correction in enumerate(closed.corrections) if correction is not None)

    def shared(camera: Camera) -> int:
        landmarks = camera.map.keyframes[first + 1].landmarks
        return int(count_shared_landmarks(camera.map, landmarks[landmarks >= 0])[: LAP // 2].sum())

    assert shared(drifted) == 0
    assert shared(closed) > 100


def test_loop_correction_keeps_landmark_reprojection() -> None:
    """Landmarks move with the keyframe that created them."""
    camera, room = Camera(), Room(seed=1)
    for _ in steps_until(lambda: camera.loop_closer.loop_count > 0, 2 * LAP, "a loop was closed"):
        camera.step(room, lap_pose(len(camera.true_poses)))
    table, landmarks = camera.map.observations, camera.map.landmarks
    T_cw = torch.stack([keyframe.T_cw for keyframe in camera.map.keyframes])[table["keyframe"]]
    points = (T_cw[:, :3, :3] @ landmarks["point"][table["landmark"], :, None])[..., 0] + T_cw[:, :3, 3]
    own = landmarks["keyframe"][table["landmark"]] == table["keyframe"]
    error = (CAMERA.project(points) - table["uv"]).norm(dim=1)
    assert own.sum() > 1000
    assert error[own].max() < 1e-6


def test_loop_correction_is_as_accurate_after_both_ends_of_an_earlier_loop_were_culled(closed: Camera) -> None:
    camera, room = Camera(), Room(seed=1)
    for k in range(2 * LAP):
        camera.step(room, lap_pose(k))
        if k == 40:
            (_, end), (begin, _) = ((loop.i, loop.j) for loop in camera.map.loops)
            references = {begin: begin + 1, end: end + 2, 15: 14}
            cull_keyframes(camera.map, references)
            camera.loop_closer.remove_keyframes(references)
    assert camera.loop_closer.loop_count == closed.loop_closer.loop_count == 3
    assert camera.errors().max() < 1.2 * closed.errors().max()


def test_earlier_loop_with_culled_ends_holds_after_the_bundle_adjustment_moved_their_references(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A bundle adjustment moves active keyframes only; here it moves all of them alike, which changes no edge."""
    camera, room = Camera(), Room(seed=1)
    for k in range(41):
        camera.step(room, lap_pose(k))
    cull_keyframes(camera.map, {end: end + 1 for loop in camera.map.loops for end in (loop.i, loop.j)})
    shift = se3_exp(torch.tensor([0.1, 0.05, -0.1, 0.02, 0.03, -0.02], dtype=torch.float64))
    active = torch.tensor([not keyframe.is_culled for keyframe in camera.map.keyframes] + [True] * 7)
    detect, compared = camera.loop_closer.detect_loop, 0

    def detect_twice(keyframe: Keyframe, sparse_map: SparseMap, T_cw: Tensor) -> LoopCorrection | None:
        nonlocal compared
        rows = active[: len(T_cw)]
        moved = detect(keyframe, sparse_map, torch.where(rows[:, None, None], T_cw @ shift, T_cw))
        correction = detect(keyframe, sparse_map, T_cw)
        if correction is not None and moved is not None:
            torch.testing.assert_close(moved.T_cw[rows], correction.T_cw[rows] @ shift, rtol=0, atol=1e-6)
            compared += 1
        return correction

    monkeypatch.setattr(camera.loop_closer, "detect_loop", detect_twice)
    for k in range(41, 2 * LAP):
        camera.step(room, lap_pose(k))
    assert compared == 1


def test_convention_correction_maps_old_world_to_new_world() -> None:
    camera, room = Camera(), Room(seed=1)
    # Without loop closing, the newest keyframe keeps the pose that it had before the correction.
    twin = Camera("loop.enabled=false")
    for _ in steps_until(lambda: camera.loop_closer.loop_count > 0, 2 * LAP, "a loop was closed"):
        k = len(camera.true_poses)
        camera.step(room, lap_pose(k))
        twin.step(room, lap_pose(k))
    T_new_old = camera.corrections[-1]
    assert T_new_old is not None
    old, new = invert(twin.map.keyframes[-1].T_cw), invert(camera.map.keyframes[-1].T_cw)
    torch.testing.assert_close(T_new_old @ old, new, rtol=0, atol=1e-9)
    assert (old[:3, 3] - new[:3, 3]).norm() > 0.05


def test_place_with_few_of_its_visible_landmarks_is_no_loop() -> None:
    """On the second lap eleven of twelve features are occluded; without the minimum ratio the rest forms a loop."""
    loop_counts = {}
    for overrides in ((), ("loop.min_inlier_ratio=0",)):
        camera, room = Camera("loop.min_inliers=15", *overrides), Room(seed=1)
        for k in range(BEFORE_LOOP):
            camera.step(room, lap_pose(k))
        assert camera.loop_closer.loop_count == 0
        # Until places that were occluded before are visible again.
        while len(camera.true_poses) < LAP + BEFORE_LOOP - 1:
            camera.step(room, lap_pose(len(camera.true_poses)), every=12)
        loop_counts[overrides] = camera.loop_closer.loop_count
    assert loop_counts[()] == 0 and loop_counts[("loop.min_inlier_ratio=0",)] > 0


class FirstRatioLowTracker(MapTracker):
    """Tracker that repeats the visible landmarks of the first pose that it finds, so that its inlier ratio is low."""

    is_first = True

    def __call__(self, *args: Any) -> MapTracking | None:
        tracking = super().__call__(*args)
        if tracking is not None and self.is_first:
            self.is_first = False
            return replace(tracking, visible=tracking.visible.repeat(100))
        return tracking


def test_candidate_with_a_low_inlier_ratio_does_not_end_the_search(drifted: Camera) -> None:
    newest = drifted.map.keyframes[LAP + 2]
    places = []
    for tracker_type in (MapTracker, FirstRatioLowTracker):
        loop_closer = make_loop_closer(load_config(), tracker_type)
        loop_closer.rebuild_database(drifted.map.keyframes[: newest.index])
        correction = loop_closer.detect_loop(newest, drifted.map, drifted.map.T_cw)
        assert correction is not None
        places.append(correction.place.keyframe.index)
    assert places[0] != places[1] and max(places) <= 5  # both are at the beginning of the first lap


def detect_in_drifted_map(drifted: Camera, gap: int) -> LoopCorrection | None:
    """Detect a loop at the keyframe `LAP + 2` with a minimum number of keyframes between the ends of a loop."""
    newest = drifted.map.keyframes[LAP + 2]
    loop_closer = make_loop_closer(load_config(overrides=[f"loop.min_keyframe_gap={gap}"]))
    loop_closer.rebuild_database(drifted.map.keyframes[: newest.index])
    return loop_closer.detect_loop(newest, drifted.map, drifted.map.T_cw)


def test_ends_of_a_loop_have_the_minimum_number_of_keyframes_between_them(drifted: Camera) -> None:
    correction = detect_in_drifted_map(drifted, 10)
    assert correction is not None
    i, j = correction.loop.i, correction.loop.j
    again, other = detect_in_drifted_map(drifted, j - i - 1), detect_in_drifted_map(drifted, j - i)
    assert again is not None and again.loop.i == i
    assert other is None or other.loop.i < i


@pytest.mark.parametrize(("end", "found"), [(LAP + 2 - 10, True), (LAP + 2 - 9, False)])
def test_loop_is_detected_again_when_the_last_one_is_old_enough(
    drifted: Camera, end: int, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    T_cw = drifted.map.T_cw
    monkeypatch.setattr(drifted.map, "loops", [Loop(0, end, T_cw[0] @ invert(T_cw[end]))])
    assert (detect_in_drifted_map(drifted, 10) is not None) is found


def test_different_rooms_form_no_loop() -> None:
    camera = Camera()
    for room in (Room(seed=1), Room(seed=2)):
        for k in range(BEFORE_LOOP):
            camera.step(room, lap_pose(k))
    assert camera.loop_closer.loop_count == 0


def test_same_descriptors_in_another_arrangement_form_no_loop() -> None:
    """Place recognition succeeds, geometric verification fails."""
    camera, room = Camera(), Room(seed=1)
    other = Room(seed=2)
    other.descriptors = room.descriptors
    database = KeyframeDatabase()
    for k in range(BEFORE_LOOP):
        database.add(k, camera.step(room, lap_pose(k)).features.descriptors)
    view, _ = other.observe(lap_pose(3), seed=99)
    assert database.query(view.descriptors, 1)[0][1] > 0.1  # recognised by appearance
    assert database.query(Room(seed=3).observe(lap_pose(3), seed=99)[0].descriptors, 1) == []
    for k in range(BEFORE_LOOP):
        camera.step(other, lap_pose(k))
    assert camera.loop_closer.loop_count == 0


def test_covisible_keyframes_form_no_loop() -> None:
    """The camera moves to and fro in front of one wall: places are recognised, but they are covisible."""
    camera, room = Camera("loop.min_keyframe_gap=3"), Room(seed=1)
    for k in range(20):
        camera.step(room, lap_pose(0) @ se3_exp(torch.tensor([0.05 * (k % 2), 0, 0, 0, 0, 0], dtype=torch.float64)))
    assert camera.loop_closer.loop_count == 0


def test_lost_camera_is_relocalised_at_its_pose() -> None:
    camera, room = Camera(), Room(seed=1)
    for k in range(10):
        camera.step(room, lap_pose(k))
    # Between two keyframes, displaced and tilted, relative to the drifting pose of keyframe 2.
    displacement = se3_exp(torch.tensor([0.15, -0.1, 0.1, 0.05, 0.08, 0.2], dtype=torch.float64))
    features, _ = room.observe(lap_pose(2) @ displacement, seed=77)
    place = camera.loop_closer.relocalise(features, camera.map)
    assert place is not None
    assert place.keyframe.index in (0, 1, 2, 3, 4)
    assert place.tracking.landmark_count > 100
    expected = invert(invert(camera.map.keyframes[2].T_cw) @ displacement)
    offset = se3_log(place.tracking.T_cw @ invert(expected)).abs()
    # As accurate as the map around the keyframe, which drifts by 6 mm per keyframe.
    assert offset[:3].max() < 0.02 and offset[3:].max() < 0.01
    assert camera.loop_closer.relocalise(Room(seed=2).observe(lap_pose(2), seed=77)[0], camera.map) is None


def test_relocalisation_fails_with_too_few_features() -> None:
    camera, room = Camera(), Room(seed=1)
    for k in range(6):
        camera.step(room, lap_pose(k))
    features, _ = room.observe(lap_pose(2), seed=77)
    assert camera.loop_closer.relocalise(features[torch.arange(39)], camera.map) is None
    assert camera.loop_closer.relocalise(features[torch.zeros(0, dtype=torch.int64)], camera.map) is None
    without_depth = replace(features, depth=torch.zeros_like(features.depth))
    assert camera.loop_closer.relocalise(without_depth, camera.map) is not None  # the landmarks of the map have depth


def test_loop_joins_the_disconnected_part_of_the_map() -> None:
    camera, room = Camera(), Room(seed=1)
    for k in range(BEFORE_LOOP):
        camera.step(room, lap_pose(k), part=int(k > 12))
    assert camera.loop_closer.loop_count == 0
    assert any(keyframe.is_disconnected for keyframe in camera.map.keyframes)
    for _ in steps_until(lambda: camera.corrections[-1] is not None, 2 * LAP, "a loop was closed"):
        camera.step(room, lap_pose(len(camera.true_poses)), part=1)
    assert not any(keyframe.is_disconnected for keyframe in camera.map.keyframes)


def test_loop_corrects_a_wrong_guess_without_deforming_the_map() -> None:
    """A lost camera is guessed half a metre off: only the loop determines the relative pose of the two parts."""
    camera, room = Camera(), Room(seed=1)
    for k in range(2 * LAP):
        camera.step(room, lap_pose(k), part=int(k >= 12), guess=WRONG_GUESS if k == 12 else None)
        if camera.corrections[-1] is not None:
            break
        if k == 11:
            before = camera.errors()
        if k == 12:
            assert camera.errors()[12] > 0.4
    assert camera.loop_closer.loop_count == 1
    torch.testing.assert_close(camera.errors()[:12], before, rtol=0, atol=1e-3)
    assert camera.errors()[12:].max() < 0.1  # drift between the loop and keyframe 12


def test_loop_of_a_camera_that_was_lost_twice_joins_only_the_part_at_its_end() -> None:
    """Parts 0, 1 and 2 begin at keyframes 0, 8 and 16; the second lap passes part 0, and then part 1."""
    camera, room = Camera(), Room(seed=1)
    for _ in steps_until(lambda: camera.loop_closer.loop_count >= 1, 2 * LAP, "loop 1 was closed"):
        k = len(camera.true_poses)
        camera.step(room, lap_pose(k), part=min(k // 8, 2), guess=WRONG_GUESS if k in (8, 16) else None)
        if k == 15:
            guessed = camera.map.T_cw[8:]
    assert camera.map.loops[0].i < 8 and camera.map.loops[0].j > 16
    assert [keyframe.part for keyframe in camera.map.keyframes] == 8 * [0] + 8 * [1] + (k - 15) * [0]
    torch.testing.assert_close(camera.map.T_cw[8:16], guessed, rtol=0, atol=1e-9)
    errors = camera.errors()
    assert errors[8] > 0.4 and errors[:8].max() < 0.1 and errors[16:].max() < 0.1
    for _ in steps_until(lambda: camera.loop_closer.loop_count >= 2, 2 * LAP, "loop 2 was closed"):
        camera.step(room, lap_pose(len(camera.true_poses)))
    assert 8 <= camera.map.loops[1].i < 16
    assert not any(keyframe.is_disconnected for keyframe in camera.map.keyframes)
    assert camera.errors().max() < 0.1


def test_loop_between_two_disconnected_parts_joins_them_to_one_disconnected_part() -> None:
    """A camera that was lost is carried to another room and is lost again there."""
    camera = Camera()
    for k in range(4):
        camera.step(Room(seed=1), lap_pose(k))
    room = Room(seed=2)
    for k in range(LAP + 4):
        camera.step(room, lap_pose(k), part=1 + k // 12, guess=WRONG_GUESS if k in (0, 12) else None)
        if camera.corrections[-1] is not None:
            break
    assert camera.loop_closer.loop_count == 1
    assert [keyframe.part for keyframe in camera.map.keyframes] == 4 * [0] + (k + 1) * [1]
    positions = invert(camera.map.T_cw[4:])[:, :3, 3]
    true_positions = torch.stack(camera.true_poses[4:])[:, :3, 3]
    error = torch.pdist(positions) - torch.pdist(true_positions)
    assert error.abs().max() < 0.1


def test_loop_closing_is_deterministic(closed: Camera) -> None:
    again = make_two_laps()
    for first, second in zip(closed.map.keyframes, again.map.keyframes, strict=True):
        assert torch.equal(first.T_cw, second.T_cw)


def test_loop_closer_that_loads_a_state_and_the_map_recognises_the_same_places(closed: Camera) -> None:
    state = closed.loop_closer.state_dict()
    assert state == {"loop_count": closed.loop_closer.loop_count} and state["loop_count"] > 0
    loaded = make_loop_closer(load_config())
    loaded.add_keyframe(closed.map.keyframes[0])  # is replaced
    loaded.load_state_dict(state)
    loaded.rebuild_database(closed.map.active_keyframes)
    assert loaded.loop_count == closed.loop_closer.loop_count
    features, _ = Room(seed=1).observe(lap_pose(5), seed=77)
    expected, place = (loop_closer.relocalise(features, closed.map) for loop_closer in (closed.loop_closer, loaded))
    assert expected is not None and place is not None
    assert place.keyframe is expected.keyframe
    assert torch.equal(place.tracking.T_cw, expected.tracking.T_cw)
    loaded.rebuild_database([])
    assert loaded.relocalise(features, closed.map) is None
