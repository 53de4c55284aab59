"""Decisions that hold on noise: who moves, and who is who, in simulated rooms with an erring network and camera.

What is asked of every scene: who walks is dynamic in at least 95 of 100 frames after the first second, what stands
still is called moving in at most 5 of 100 frames from the first on, and nobody changes the id.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from helpers.scenes import (
    CAMERA,
    CHAIR,
    COUCH,
    DOG,
    TABLE,
    TV,
    WALL,
    Network,
    Run,
    Thing,
    chair,
    furniture,
    handheld,
    measured,
    person,
    play,
    render,
    roaming,
    stand,
    still_camera,
    walk,
)
from torch import Tensor

from v3d_torch.config import StaticMaskConfig, TrackerConfig
from v3d_torch.geometry.camera import BackProjector
from v3d_torch.objects.motion_classifier import MotionState

PAPER = Path(__file__).parents[2] / "configs" / "paper.yaml"
MOVING = (MotionState.DYNAMIC, MotionState.DEFORMING)
GAP, CONFIRM = TrackerConfig().max_missed_time, StaticMaskConfig().confirm_static_time
SEEDS = pytest.mark.parametrize("seed", [0, 1])
THREE_SEEDS = pytest.mark.parametrize("seed", [0, 1, 2])

LEFT_CHAIR, RIGHT_CHAIR = chair(stand(-1.25, 3.3)), chair(stand(1.2, 3.0))
DESK = furniture(TABLE, stand(0.55, 2.25), (1.2, 0.75, 0.4))
PARTIAL = Network(contour=0.6, bite=0.15, shuffled=True)


def assert_still(run: Run, *things: int, most: float = 0.05) -> None:
    assert {thing: share for thing in things if (share := run.share(thing, *MOVING)) > most} == {}


def assert_dynamic(run: Run, *things: int, since: float = 1.0) -> None:
    assert {
        thing: share for thing in things if (share := run.share(thing, MotionState.DYNAMIC, since=since)) < 0.95
    } == {}


def assert_id(run: Run, *things: int) -> None:
    ids = [run.ids(thing) for thing in things]
    assert [len(one) for one in ids] == [1] * len(things), ids
    assert len(set.union(*ids)) == len(things), ids


# ---------------------------------------------------------------- the simulator itself


def test_simulated_depth_lies_on_what_is_there() -> None:
    t = torch.tensor([0.3, 1.1], dtype=torch.float64)
    T_wc = roaming(t)
    depth, owner = render([RIGHT_CHAIR, person(stand(-0.4, 2.8))], t, T_wc)
    points = BackProjector(CAMERA)(depth[:, None]).double() @ T_wc[:, None, :3, :3].mT + T_wc[:, None, None, :3, 3]
    assert set(owner.unique().tolist()) == {-1, 0, 1}
    assert float(points[owner == -1][:, 2].max()) == pytest.approx(WALL, abs=1e-4)
    assert float(points[owner == -1][:, 1].max()) == pytest.approx(1.2, abs=1e-4)
    low, high = points[owner == 1].aminmax(dim=0)
    torch.testing.assert_close(low[:2], torch.tensor([-0.6, 1.2 - 1.73]).double(), atol=0.03, rtol=0.0)
    torch.testing.assert_close(high[:2], torch.tensor([-0.2, 1.2]).double(), atol=0.03, rtol=0.0)
    assert float(points[owner == 0][:, 2].min()) == pytest.approx(3.0 - 0.23, abs=1e-4)
    error = measured(depth, torch.Generator().manual_seed(0)) - depth
    sigma = (error / depth.square())[(error != -depth) & (depth > 2.5)].std()
    assert float(sigma) == pytest.approx(math.hypot(0.0014, 0.00285 / math.sqrt(12)), rel=0.05)


@pytest.mark.parametrize("scene", ["a slow walker", "partial views"])
def test_scenes_are_hard_enough_to_break_the_paper_s_literal_rules(scene: str) -> None:
    if scene == "a slow walker":
        things = (LEFT_CHAIR, RIGHT_CHAIR, person(walk(-0.9, 2.8, 0.9, 0.0), 0.2))
        assert play(*things, seconds=1.5, rate=30.0, config=PAPER).share(2, MotionState.DYNAMIC) < 0.5
    else:
        run = play(*cluttered(), seconds=1.0, network=PARTIAL, config=PAPER)
        assert max(run.share(thing, *MOVING) for thing in range(5)) > 0.2


# ---------------------------------------------------------------- partial views


def cluttered(*more: Thing) -> tuple[Thing, ...]:
    """A chair cut by the image border, a chair and a person half behind a desk."""
    still = (chair(stand(-1.8, 3.0)), chair(stand(1.15, 3.1)), person(stand(0.3, 3.3)), DESK)
    return (*still, furniture(TV, stand(-0.7, 4.6, 0.2), (0.9, 0.55, 0.1)), *more)


@SEEDS
def test_nobody_moves_where_all_are_seen_in_part(seed: int) -> None:
    run = play(*cluttered(), seconds=1.8, seed=seed, camera=[handheld, roaming][seed], network=PARTIAL)
    assert_still(run, 0, 1, 2, 3, 4)
    assert run.share(2, MotionState.STATIC, since=CONFIRM + 0.2) >= 0.95


@SEEDS
def test_the_walker_alone_moves_where_all_are_seen_in_part(seed: int) -> None:
    things = cluttered(person(walk(-1.3, 2.75 + 0.05 * seed, 1.0, 0.0), 0.2))
    run = play(*things, seconds=1.8, seed=seed, network=PARTIAL)
    assert_dynamic(run, 5)
    assert_still(run, 0, 1, 2, 3, 4)


# ---------------------------------------------------------------- slow walkers, few frames, few objects


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_three_centimetres_a_frame_and_less(seed: int) -> None:
    """0.9 m/s aside, towards the camera and away; 0.5 m/s: 3 cm and 1.7 cm a frame."""
    x, z, vx, vz = [(-0.9, 2.8, 0.9, 0.0), (0.3, 4.3, 0.0, -0.9), (0.7, 2.6, -0.6, 0.67), (-0.5, 2.8, 0.5, 0.0)][seed]
    things = (LEFT_CHAIR, RIGHT_CHAIR, person(walk(x, z, vx, vz), 0.2))
    run = play(*things, seconds=1.4, rate=30.0, seed=seed, pose_error=True)
    assert_dynamic(run, 2)
    assert_still(run, 0, 1)
    assert_id(run, 0, 1, 2)


@THREE_SEEDS
def test_five_frames_a_second(seed: int) -> None:
    """Two walkers make 20 to 24 cm a frame."""
    walkers = person(walk(-1.3, 2.7, 1.2, -0.1), 0.25), person(walk(1.2, 3.9, -0.8, -0.3), 0.25, phase=2.0)
    things = (LEFT_CHAIR, RIGHT_CHAIR, *walkers)
    run = play(
        *things, seconds=2.4, rate=5.0, seed=seed, camera=[handheld, roaming, still_camera][seed], network=PARTIAL
    )
    assert_dynamic(run, 2, 3)
    assert_still(run, 0, 1)
    assert_id(run, 2, 3)


@SEEDS
def test_one_object_alone(seed: int) -> None:
    walking = play(person(walk(-0.8, 2.8, 0.9, 0.0), 0.2), seconds=1.5, seed=seed, network=PARTIAL)
    assert_dynamic(walking, 0)
    for thing in (person(stand(0.2, 2.6)), chair(stand(0.2, 2.6))):
        run = play(thing, seconds=1.5, seed=seed, network=PARTIAL, camera=roaming)
        assert_still(run, 0)
        assert run.share(0, MotionState.STATIC, since=CONFIRM + 0.2) >= 0.95


@SEEDS
def test_two_objects_only(seed: int) -> None:
    walker = person(walk(-1.2, 2.8, 0.9, 0.2), 0.2)
    one = play(walker, RIGHT_CHAIR, seconds=1.5, seed=seed, network=PARTIAL)
    assert_dynamic(one, 0)
    assert_still(one, 1)
    none = play(person(stand(-0.5, 2.8)), RIGHT_CHAIR, seconds=1.5, seed=seed, network=PARTIAL, camera=roaming)
    assert_still(none, 0, 1)
    both = play(walker, person(walk(0.4, 3.4, 0.5, 0.4), 0.2), seconds=1.5, seed=seed, network=PARTIAL)
    assert_dynamic(both, 0, 1)


# ---------------------------------------------------------------- who is who


@SEEDS
def test_somebody_enters_walks_through_and_leaves(seed: int) -> None:
    """In sight from about 0.2 to 2.1 s, cut by the image border at both ends."""
    run = play(LEFT_CHAIR, RIGHT_CHAIR, person(walk(-1.7, 2.0, 1.5, 0.0), 0.25), seconds=2.8, seed=seed)
    last = max(frame.stamp for frame in run.frames if 2 in frame.shown)
    assert 1.8 < last < 2.2
    assert_dynamic(run, 2)
    assert run.share(2, MotionState.STATIC) == 0
    assert_id(run, 0, 1, 2)
    assert_still(run, 0, 1)
    after = [len(frame.scene.objects) for frame in run.frames if frame.stamp > last + GAP + 0.01]
    assert set(after) == {2}


@SEEDS
@pytest.mark.parametrize(("turn", "same"), [(0.78, True), (1.3, False)])
def test_somebody_leaves_and_comes_back(seed: int, turn: float, same: bool) -> None:
    """Out of sight for less than half a second the id stays; after more than a second it is a new one."""

    def out_and_in(t: Tensor) -> Tensor:
        x = 0.6 + 1.2 * (turn - (t - turn).abs())
        return torch.stack([x, torch.full_like(t, 1.2), torch.full_like(t, 2.0)], dim=-1)

    run = play(LEFT_CHAIR, person(out_and_in, 0.2), seconds=2 * turn, seed=seed)
    before, after = run.ids(1, until=turn), run.ids(1, since=turn)
    assert len(before) == len(after) == 1
    assert (before == after) is same
    assert run.share(1, MotionState.STATIC) == 0


@pytest.mark.parametrize(("seed", "rate"), [(0, 8.0), (1, 8.0), (0, 30.0)])
def test_two_who_cross_keep_their_ids(seed: int, rate: float) -> None:
    """1 m/s each way, 0.7 m apart in depth, the instances in any order."""
    near, far = person(walk(-0.8, 2.5, 1.0, 0.0), 0.2), person(walk(0.9, 3.2, -1.0, 0.0), 0.2, phase=1.0)
    run = play(LEFT_CHAIR, near, far, seconds=1.6, rate=rate, seed=seed, network=Network(shuffled=True))
    assert_id(run, 1, 2)
    assert_dynamic(run, 1, 2)
    assert_still(run, 0)


@SEEDS
def test_two_who_meet_and_turn_back_keep_their_ids(seed: int) -> None:
    """They come as near as half a metre, where a prediction has them walk through each other."""

    def approach(side: float) -> Thing:
        def place(t: Tensor) -> Tensor:
            x = side * (0.27 + 0.9 * (t - 0.9).abs())
            return torch.stack([x, torch.full_like(t, 1.2), torch.full_like(t, 2.7)], dim=-1)

        return person(place, 0.2)

    run = play(approach(-1), approach(1), LEFT_CHAIR, seconds=1.8, seed=seed, network=Network(shuffled=True))
    assert_id(run, 0, 1)
    assert_dynamic(run, 0, 1)


# ---------------------------------------------------------------- occluders


@SEEDS
def test_a_walker_behind_a_pillar(seed: int) -> None:
    """No class names the pillar; it hides the walker wholly for 0.2 s and in part for 0.8 s."""
    pillar = furniture(None, stand(-0.1, 1.8), (0.36, 2.6, 0.3))
    things = (LEFT_CHAIR, RIGHT_CHAIR, person(walk(-1.05, 2.7, 0.9, 0.0), 0.2), pillar)
    run = play(*things, seconds=2.0, seed=seed)
    assert any(2 not in frame.shown for frame in run.frames)
    assert_dynamic(run, 2)
    assert_id(run, 2)
    assert_still(run, 0, 1)


@pytest.mark.parametrize(("seed", "depth"), [(0, 2.0), (1, 2.0), (0, 3.1)])
def test_a_walker_in_front_of_and_behind_a_desk(seed: int, depth: float) -> None:
    desk = furniture(TABLE, stand(0.1, 2.6), (0.9, 0.75, 0.5))
    run = play(LEFT_CHAIR, desk, person(walk(-0.8, depth, 0.9, 0.0), 0.2), seconds=1.8, seed=seed)
    assert_dynamic(run, 2)
    assert_still(run, 0, 1)
    assert_id(run, 0, 1, 2)


@SEEDS
def test_somebody_still_whom_a_walker_hides_for_a_moment(seed: int) -> None:
    things = (LEFT_CHAIR, person(stand(0.1, 3.4)), person(walk(-0.9, 2.4, 1.0, 0.0), 0.2))
    run = play(*things, seconds=2.0, seed=seed)
    assert any(1 not in frame.shown for frame in run.frames)
    assert_still(run, 0, 1)
    assert_dynamic(run, 2)
    assert_id(run, 1, 2)
    assert run.share(1, MotionState.STATIC, since=CONFIRM + 0.2) >= 0.95


# ---------------------------------------------------------------- what the network misses, and misnames


@pytest.mark.parametrize(("seed", "missed"), [(0, 3), (0, 10), (1, 10)])
def test_a_walker_missed_for_some_frames_is_bridged(seed: int, missed: int) -> None:
    """At 30 frames a second; in 10 frames the walker comes by the width of a body."""
    network = Network(missed=lambda thing, t: thing == 1 and 0.69 < t < 0.69 + missed / 30)
    things = (RIGHT_CHAIR, person(walk(-0.8, 2.6, 1.2, 0.0), 0.2))
    run = play(*things, seconds=1.15, rate=30.0, seed=seed, network=network)
    assert_id(run, 1)
    (number,) = run.ids(1)
    gap = [frame for frame in run.frames if 1 not in frame.shown]
    assert len(gap) == missed
    bridged = [judged for frame in gap for judged in frame.scene.objects if judged.id == number]
    assert [judged.motion_state for judged in bridged] == [MotionState.DYNAMIC] * missed
    assert min(frame.overlap(judged, 1) for frame, judged in zip(gap, bridged, strict=True)) >= 0.5
    # Legs swing; the cloud that is moved on does not.
    left_out = [float((~frame.scene.static_mask)[frame.owner == 1].double().mean()) for frame in gap]
    assert min(left_out) >= 0.85
    assert run.share(1, MotionState.DYNAMIC, since=0.69) >= 0.95


@SEEDS
def test_nobody_is_bridged_for_longer_than_the_stated_time(seed: int) -> None:
    network = Network(missed=lambda thing, t: thing == 1 and 0.79 < t < 1.49)
    nameless = ("objects.free_space.min_unlabelled_area=100",)  # or he goes on as what moves and has no name
    things = (RIGHT_CHAIR, person(walk(-0.8, 2.6, 0.9, 0.0), 0.2))
    run = play(*things, seconds=1.8, seed=seed, network=network, overrides=nameless)
    (before,), (after,) = run.ids(1, until=0.8), run.ids(1, since=1.45)
    assert before != after
    last = max(frame.stamp for frame in run.frames for judged in frame.scene.objects if judged.id == before)
    assert last == pytest.approx(max(f.stamp for f in run.frames if f.stamp < 0.79) + GAP, abs=1.01 / 12)


@SEEDS
def test_a_network_that_misses_every_third_frame(seed: int) -> None:
    network = Network(missed=lambda thing, t: (round(12 * t) + thing) % 3 == 2, bite=0.15, shuffled=True)
    things = (LEFT_CHAIR, RIGHT_CHAIR, person(walk(-0.9, 2.8, 0.9, 0.0), 0.2))
    run = play(*things, seconds=1.8, seed=seed, network=network)
    assert_id(run, 0, 1, 2)
    assert_dynamic(run, 2)
    assert_still(run, 0, 1)


@THREE_SEEDS
def test_classes_that_flicker(seed: int) -> None:
    network = Network(flicker={0: (COUCH, 0.4), 1: (COUCH, 0.4), 2: (DOG, 0.4)}, shuffled=True)
    things = (LEFT_CHAIR, RIGHT_CHAIR, person(walk(-0.9, 2.8, 0.9, 0.0), 0.2))
    run = play(*things, seconds=1.8, rate=10.0, seed=seed, network=network)
    assert_id(run, 0, 1, 2)
    assert_dynamic(run, 2)
    assert_still(run, 0, 1)
    labels = {judged.label for frame in run.frames if (judged := frame.of(0)) is not None and frame.stamp > 1.0}
    assert labels <= {CHAIR, COUCH}


# ---------------------------------------------------------------- poses that are off


@SEEDS
def test_what_stands_is_static_under_a_camera_whose_pose_is_off(seed: int) -> None:
    """By 3 mm and 0.2 degrees a frame, and drifting by 1 cm/s; a thing may be doubted for a tenth of the time."""
    run = play(*cluttered(), seconds=2.0, seed=seed, camera=roaming, pose_error=True)
    assert_still(run, 0, 1, 2, 3, 4, most=0.1)


@SEEDS
def test_a_walker_is_dynamic_under_a_camera_whose_pose_is_off(seed: int) -> None:
    things = (LEFT_CHAIR, RIGHT_CHAIR, person(walk(-0.8, 2.9, 0.7, 0.3), 0.2))
    run = play(*things, seconds=2.0, seed=seed, camera=roaming, pose_error=True, network=PARTIAL)
    assert_dynamic(run, 2)
    assert_still(run, 0, 1)


# ---------------------------------------------------------------- kinds of motion


@THREE_SEEDS
def test_a_pushed_chair(seed: int) -> None:
    """0.5 m/s, aside, away and towards the camera."""
    path = [walk(-0.6, 2.6, 0.5, 0.0), walk(-0.2, 2.4, 0.0, 0.5), walk(0.2, 3.8, -0.2, -0.46)][seed]
    run = play(LEFT_CHAIR, RIGHT_CHAIR, chair(path), seconds=2.0, seed=seed)
    assert_dynamic(run, 2)
    assert_still(run, 0, 1)


@SEEDS
def test_somebody_who_sits_still_becomes_static(seed: int) -> None:
    things = (LEFT_CHAIR, RIGHT_CHAIR, person(stand(0.1, 2.7), seated=True))
    run = play(*things, seconds=2.0, seed=seed, network=PARTIAL)
    assert run.share(2, MotionState.UNKNOWN, until=CONFIRM - 0.1) >= 0.95
    assert run.share(2, MotionState.STATIC, since=CONFIRM + 0.1) >= 0.95


@SEEDS
def test_somebody_who_waves_deforms(seed: int) -> None:
    things = (LEFT_CHAIR, RIGHT_CHAIR, person(stand(0.0, 2.6), wave=0.3, phase=float(seed)))
    run = play(*things, seconds=2.0, seed=seed)
    assert run.share(2, MotionState.DEFORMING, since=1.0) >= 0.95
    assert run.share(2, MotionState.DYNAMIC) <= 0.05
    assert_still(run, 0, 1)


@SEEDS
def test_somebody_who_stood_sets_off_and_somebody_who_walked_stops(seed: int) -> None:
    """Both at 1.2 s: the one is found within 0.5 s; the other's verdict holds for a second after the last evidence."""
    things = (
        LEFT_CHAIR,
        person(walk(0.7, 3.2, -0.9, 0.0, start=1.2)),
        person(walk(-1.1, 2.5, 0.9, 0.0, stop=1.2), 0.2),
        chair(stand(1.6, 3.2)),
    )
    run = play(*things, seconds=2.2, seed=seed, network=PARTIAL)
    assert run.share(1, *MOVING, until=1.2) <= 0.05
    assert_dynamic(run, 1, since=1.7)
    assert_dynamic(run, 2, since=1.0)
    assert_still(run, 0, 3)


# ---------------------------------------------------------------- crowds


@SEEDS
def test_four_walk_in_all_directions_among_two_chairs(seed: int) -> None:
    walkers = (
        person(walk(-1.2, 2.3, 0.8, 0.1), 0.2),
        person(walk(1.2, 3.9, -0.8, 0.0), 0.2, phase=1.0),
        person(walk(-0.4, 4.6, 0.1, -0.9), 0.2, phase=2.0),
        person(walk(0.5, 2.6, 0.3, 0.8), 0.2, phase=3.0),
    )
    things = (chair(stand(-1.6, 3.2)), chair(stand(1.5, 3.4)), *walkers)
    run = play(*things, seconds=1.8, seed=seed, network=Network(shuffled=True), pose_error=True)
    # Whoever comes out from behind another may be a stranger for a moment, but is not static, nor used for tracking.
    assert sum(run.share(thing, MotionState.DYNAMIC, since=1.0) for thing in (2, 3, 4, 5)) / 4 >= 0.9
    assert {thing: share for thing in (2, 3, 4, 5) if (share := run.share(thing, MotionState.STATIC)) > 0.05} == {}
    assert {thing: share for thing in (2, 3, 4, 5) if (share := run.usable(thing)) > 0.05} == {}
    assert_still(run, 0, 1)
    assert {thing: share for thing in (0, 1) if (share := run.usable(thing)) < 0.75} == {}


@SEEDS
def test_all_walk_the_same_way_at_the_same_speed(seed: int) -> None:
    """The distances between them never change: they have no votes for each other."""
    walkers = [person(walk(x, z, 0.9, 0.0), 0.2, phase=x) for x, z in ((-1.3, 3.2), (-0.5, 2.6), (0.3, 3.4))]
    run = play(*walkers, seconds=1.6, seed=seed, camera=[still_camera, handheld][seed])
    assert_dynamic(run, 0, 1, 2)
    assert_id(run, 0, 1, 2)
