"""Who moves, on rooms of boxes with known truth: walkers, swayers, and all that only looks as if it moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.scenes import NO_WITNESSES
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from v3d_torch.config import ObjectsConfig
from v3d_torch.config.loading import load_config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.feature_support import FeatureSupport
from v3d_torch.objects.free_space_check import DepthView, FreeSpaceCheck
from v3d_torch.objects.instance_clouds import InstanceBackProjector, InstanceClouds
from v3d_torch.objects.motion_classifier import FrameObjects, MotionClassifier, MotionState, TrackedObject
from v3d_torch.objects.unlabelled import unlabelled_instances
from v3d_torch.segmentation.coco import PERSON, UNLABELLED
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
STRIDE = "objects.clouds.stride=1"  # a quarter of the usual resolution
NAMED_ONLY = "objects.free_space.min_unlabelled_area=100.0"  # square metres: what the network misses is not proposed
PAPER = Path(__file__).parents[2] / "configs" / "paper.yaml"
HERE = torch.eye(4, dtype=torch.float64)
WALL = 5.0
DOG, CHAIR, TV = 16, 56, 62
LEAST_PIXELS = 25  # the network finds nothing smaller

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]  # centre and size, metres, along the axes of the world


@dataclass(frozen=True)
class Thing:
    """An object made of boxes that may move: ``boxes`` of a time in seconds."""

    label: int
    boxes: Callable[[float], list[Box]]


def still(centre: Vector, size: Vector = (0.5, 0.6, 0.5), label: int = CHAIR) -> Thing:
    return Thing(label, lambda _: [(centre, size)])


def walker(start: Vector, velocity: Vector, stop: float = math.inf, label: int = PERSON) -> Thing:
    """Somebody 1.5 m tall who walks on until ``stop`` seconds."""

    def boxes(t: float) -> list[Box]:
        t = min(t, stop)
        x, y, z = (s + v * t for s, v in zip(start, velocity, strict=True))
        return [((x, y, z), (0.4, 1.5, 0.3))]

    return Thing(label, boxes)


def swayer(centre: Vector) -> Thing:
    """Somebody whose arms go up and down on both sides alike, once in 1.2 s: the middle stays where it is."""

    def boxes(t: float) -> list[Box]:
        x, y, z = centre
        reach = 0.02 + 0.3 * (0.5 - 0.5 * math.cos(2 * math.pi * t / 1.2))
        return [((x, y, z), (0.35, 1.0, 0.25)), ((x, y, z), (0.35 + 2 * reach, 0.4, 0.2))]

    return Thing(PERSON, boxes)


CHAIRS = (still((-1.1, 0.4, 2.8)), still((1.1, 0.3, 3.2)), still((0.2, -0.7, 4.2), (0.8, 0.5, 0.2), TV))


def photograph(things: list[Thing], t: float, T_wc: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Depth (1, H, W), with the noise of a structured-light camera, and the thing at each pixel, -1 = the wall."""
    origin = T_wc[:3, 3]
    direction = CAMERA.rays.double() @ T_wc[:3, :3].T  # of unit depth: a distance along it is a depth
    depth = (WALL - origin[2]) / direction[..., 2]
    owner = torch.full(depth.shape, -1)
    for i, thing in enumerate(things):
        for centre, size in thing.boxes(t):
            middle, half = (torch.tensor(vector, dtype=torch.float64) for vector in (centre, size))
            a, b = (middle - half / 2 - origin) / direction, (middle + half / 2 - origin) / direction
            enters, leaves = torch.minimum(a, b).amax(dim=-1), torch.maximum(a, b).amin(dim=-1)
            hit = (enters <= leaves) & (enters > 0.1) & (enters < depth)
            depth[hit], owner[hit] = enters[hit], i
    generator = torch.Generator().manual_seed(round(1000 * t))
    error = noise * depth.square() * torch.randn(depth.shape, generator=generator, dtype=torch.float64)
    return (depth + error)[None].float(), owner


def found(owner: Tensor, things: list[Thing], hidden: set[int], score: float = 1.0) -> Instances:
    """What a network sees that misses ``hidden`` things and all small ones, and is so sure of the others."""
    seen = [i for i in range(len(things)) if i not in hidden and int((owner == i).sum()) >= LEAST_PIXELS]
    if not seen:
        return Instances.empty(CAMERA.height, CAMERA.width)
    labels = torch.tensor([things[i].label for i in seen])
    masks = torch.stack([owner == i for i in seen])
    return Instances(masks, labels, torch.full((len(seen),), score), torch.zeros(len(seen), 4))


def away_from(mask: Tensor) -> Tensor:
    """Pixels to the nearest one of a mask, 0 within."""
    return torch.from_numpy(distance_transform_edt(~mask))


def standing(_: float) -> Tensor:
    return HERE


def handheld(t: float) -> Tensor:
    """0.4 m/s sideways, 0.15 m/s forward, and 0.2 rad/s of turning."""
    return se3_exp(
        torch.tensor([0.4 * t - 0.2, 0.05 * math.sin(6 * t), 0.15 * t, 0.03, 0.15 - 0.2 * t, 0.02 * t]).double()
    )


class Stage:
    """The object stage in the order of `V3DSLAM`; ``instances`` are those of the last frame, the unnamed among them."""

    def __init__(self, config: ObjectsConfig) -> None:
        self._config = config
        self._watch = FreeSpaceCheck(config.free_space, CAMERA)
        self._lift = InstanceBackProjector(config.clouds, CAMERA)
        self._judge = MotionClassifier(config, CAMERA)
        self.instances = Instances.empty(CAMERA.height, CAMERA.width)
        self.witnesses = NO_WITNESSES

    def __call__(
        self, stamp: float, named: Instances, depth: Tensor, T_wc: Tensor, lifted: Tensor | None = None
    ) -> FrameObjects:
        """Judge a frame; clouds are of the depth ``lifted`` where the background is to see another one."""
        view = self._watch.make_view(stamp, depth, invert(T_wc))
        arrivals = self._watch(view)
        unnamed = unlabelled_instances(arrivals, named, depth, CAMERA, self._config.free_space.min_unlabelled_area)
        self.instances = named.concatenate(unnamed)
        clouds = self._lift(depth if lifted is None else lifted, self.instances)
        scene = self._judge(self.instances, clouds, view, arrivals, self.witnesses)
        self._watch.remember(view)
        return scene

    def move_world(self, T_new_old: Tensor) -> None:
        self._judge.tracker.move_world(T_new_old)
        self._watch.move_world(T_new_old)


@dataclass(frozen=True)
class Frame:
    """What was shown and what came of it."""

    stamp: float
    owner: Tensor
    scene: FrameObjects

    def __getitem__(self, number: int) -> TrackedObject:
        """The object with this id: where all things are seen at the start, things have the ids 1, 2, 3 ..."""
        (judged,) = [judged for judged in self.scene.objects if judged.id == number]
        return judged


def play(
    *things: Thing,
    seconds: float,
    rate: float = 15.0,
    camera: Callable[[float], Tensor] = standing,
    overrides: tuple[str, ...] = (),
    path: Path | None = None,
    hidden: Callable[[float], set[int]] = lambda _: set(),
    score: float = 1.0,
    grown: float = 0.0,
    noise: float = 0.0014,
    correction: tuple[float, Tensor] | None = None,
) -> list[Frame]:
    """Show things to the object stage.

    ``dilate`` is by how many pixels the network draws its masks too large, or too small if negative; ``correction`` is a
    time and by what the map is corrected then.
    """
    stage = Stage(load_config(path, (STRIDE, *overrides)).objects)
    T_new_old, frames = HERE, []
    for index in range(round(seconds * rate) + 1):
        t = index / rate
        if correction is not None and T_new_old is HERE and t >= correction[0]:
            T_new_old = correction[1]
            stage.move_world(T_new_old)
        depth, owner = photograph(list(things), t, camera(t), noise)
        named = found(owner, list(things), hidden(t), score)
        drawn = (
            torch.stack([away_from(mask) - away_from(~mask) <= grown for mask in named.masks]) if grown else named.masks
        )
        scene = stage(t, replace(named, masks=drawn), depth, T_new_old @ camera(t))
        frames.append(Frame(t, owner, scene))
    return frames


def verdicts(frames: list[Frame], number: int) -> set[MotionState]:
    return {judged.motion_state for frame in frames for judged in frame.scene.objects if judged.id == number}


def of_class(frames: list[Frame], label: int, *but: int) -> set[MotionState]:
    """Verdicts on a class but for some ids: what comes out of cover may have a new one."""
    objects = [judged for frame in frames for judged in frame.scene.objects]
    return {judged.motion_state for judged in objects if judged.label == label and judged.id not in but}


def first(frames: list[Frame], number: int, verdict: MotionState) -> float:
    """When an object is first judged so, seconds."""
    return next((frame.stamp for frame in frames if frame[number].motion_state is verdict), math.inf)


def ids(frames: list[Frame]) -> set[int]:
    return {judged.id for frame in frames for judged in frame.scene.objects}


RATES = pytest.mark.parametrize("rate", [5.0, 30.0])
CAMERAS = pytest.mark.parametrize("camera", [standing, handheld])


@RATES
@CAMERAS
def test_a_walker_among_what_stands_is_dynamic_and_nothing_else_is(
    rate: float, camera: Callable[[float], Tensor]
) -> None:
    """0.9 m/s, at 30 frames a second 3 cm a frame: no more than noise from frame to frame, found within 0.4 s."""
    frames = play(*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.1)), seconds=1.0, rate=rate, camera=camera)
    assert first(frames, 4, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert frames[-1][4].motion_state is MotionState.DYNAMIC
    assert frames[-1][4].votes >= 2
    ballots = {ballot for frame in frames for ballot in frame.scene.vote_pairs}
    assert any(elected == 4 for _, elected in ballots) and 4 not in {voter for voter, _ in ballots}
    assert {4} == {judged.id for frame in frames for judged in frame.scene.objects if judged.label == PERSON}
    assert of_class(frames, CHAIR) == of_class(frames, TV) == {MotionState.STATIC}


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.9), (0.0, 0.0, -0.6), (0.5, 0.0, 0.7)])
def test_a_walker_along_the_line_of_sight_is_found_as_well(velocity: Vector) -> None:
    frames = play(*CHAIRS, walker((-0.2, 0.1, 2.2), velocity), seconds=0.6)
    assert first(frames, 4, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert all(verdicts(frames, number) == {MotionState.STATIC} for number in (1, 2, 3))


@CAMERAS
@pytest.mark.parametrize("second", [(-0.8, 0.0, 0.0), (0.8, 0.0, 0.3)])
def test_two_walkers_do_not_outvote_what_stands(camera: Callable[[float], Tensor], second: Vector) -> None:
    start = (0.5, 0.0, 3.4) if second[0] < 0 else (-0.9, 0.0, 3.4)
    things = (*CHAIRS[:2], walker((-0.4, 0.1, 2.2), (0.8, 0.0, 0.0)), walker(start, second))
    frames = play(*things, seconds=0.8, camera=camera)
    assert ids(frames) == {1, 2, 3, 4}
    assert first(frames, 3, MotionState.DYNAMIC) <= 0.45
    assert first(frames, 4, MotionState.DYNAMIC) <= 0.6  # it is covered for a while
    assert verdicts(frames, 1) == verdicts(frames, 2) == {MotionState.STATIC}
    # Each walker's distance to each chair changes, but who moves is no witness: the chairs have no vote at all.
    assert {frame[number].votes for frame in frames for number in (1, 2)} == {0}


@CAMERAS
def test_one_object_alone(camera: Callable[[float], Tensor]) -> None:
    """Nobody else has a vote: the background decides."""
    walking = play(walker((-0.5, 0.1, 2.5), (0.9, 0.0, 0.0)), seconds=0.6, camera=camera)
    assert first(walking, 1, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert verdicts(play(CHAIRS[0], seconds=1.2, camera=camera), 1) == {MotionState.STATIC}


@pytest.mark.parametrize("label", [CHAIR, PERSON])
def test_what_a_walker_passes_in_front_of_stands(label: int) -> None:
    """It is cut, then covered, then comes out: its centroid jumps all the time."""
    standing_still = still((0.2, 0.3, 3.2), (0.9, 0.7, 0.4), label)
    frames = play(standing_still, CHAIRS[0], walker((-0.45, 0.1, 2.0), (1.0, 0.0, 0.0)), seconds=1.3)
    pixels = [int((frame.owner == 0).sum()) for frame in frames]
    assert 50 < min(pixels) < 0.5 * pixels[0]
    shown = [judged for frame in frames for judged in frame.scene.objects if judged.label == label and judged.id != 3]
    x = torch.tensor([float(judged.centroid[0]) for judged in shown if label == PERSON or judged.id != 2])
    assert float((x - x[0]).abs().max()) > 0.15
    assert of_class(frames, CHAIR) == {MotionState.STATIC}
    assert of_class(frames, PERSON, 3) <= {MotionState.UNKNOWN, MotionState.STATIC}
    assert frames[-1][3].motion_state is MotionState.DYNAMIC


@pytest.mark.parametrize("label", [CHAIR, PERSON])
def test_what_the_image_border_cuts_as_the_camera_turns_stands(label: int) -> None:
    """0.6 rad/s; the wide box slides out of the image, and its centroid along it."""

    def turning(t: float) -> Tensor:
        return se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.6 * t, 0.0], dtype=torch.float64))

    wide = still((-0.8, 0.3, 2.6), (1.0, 0.4, 0.6), label)
    frames = play(wide, CHAIRS[1], still((0.4, -0.5, 3.5)), seconds=0.9, camera=turning)
    assert int((frames[-1].owner == 0).sum()) < 0.4 * int((frames[0].owner == 0).sum())
    assert float((frames[-1][1].centroid - frames[0][1].centroid).norm()) > 0.15
    assert verdicts(frames, 1) == {
        MotionState.STATIC if label == CHAIR else MotionState.UNKNOWN
    }  # not yet for a second
    assert verdicts(frames, 2) == verdicts(frames, 3) == {MotionState.STATIC}


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.3), (0.9, 0.0, 0.0)])
def test_a_chair_that_is_pushed_is_dynamic(velocity: Vector) -> None:
    """Things have no gait to tell them by: they must leave their places."""
    x, y, z = velocity
    pushed = Thing(CHAIR, lambda t: [((-0.4 + x * t, 0.3 + y * t, 2.5 + z * t), (0.5, 0.6, 0.5))])
    frames = play(*CHAIRS, pushed, seconds=0.8)
    assert first(frames, 4, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert all(verdicts(frames, number) == {MotionState.STATIC} for number in (1, 2, 3))


def test_a_chair_that_is_pushed_slowly_aside_is_dynamic_within_a_second() -> None:
    """0.4 m/s: in 0.3 s it has left a quarter of its half metre, in a second four fifths."""
    pushed = Thing(CHAIR, lambda t: [((-0.6 + 0.4 * t, 0.3, 2.2), (0.5, 0.6, 0.5))])
    frames = play(*CHAIRS, pushed, seconds=1.4)
    assert all(verdicts(frames, number) == {MotionState.STATIC} for number in (1, 2, 3))
    assert first(frames, 4, MotionState.DYNAMIC) <= 1.1


@CAMERAS
def test_a_swayer_deforms_and_is_not_dynamic(camera: Callable[[float], Tensor]) -> None:
    frames = play(*CHAIRS, swayer((0.0, 0.1, 2.4)), seconds=2.0, camera=camera)
    assert MotionState.DYNAMIC not in verdicts(frames, 4)
    assert first(frames, 4, MotionState.DEFORMING) <= 0.6
    assert {frame[4].motion_state for frame in frames if frame.stamp > 0.6} == {MotionState.DEFORMING}
    assert max(frame[4].chamfer for frame in frames if frame.stamp >= 0.3) > 0.025
    for number in (1, 2, 3):
        assert verdicts(frames, number) == {MotionState.STATIC}


def test_chamfer_of_somebody_who_stands_is_noise_and_things_have_none() -> None:
    things = (*CHAIRS, walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)))
    frames = play(*things, seconds=0.8, camera=handheld)
    assert all(math.isnan(frame[4].chamfer) for frame in frames if frame.stamp < 0.29)
    assert all(0 < frame[4].chamfer < 0.02 for frame in frames if frame.stamp > 0.31)
    assert all(math.isnan(frame[number].chamfer) for frame in frames for number in (1, 2, 3))


def test_chamfer_is_asked_of_those_alone_whom_the_votes_leave_as_static() -> None:
    """Somebody who walks changes shape all the time; who has come to rest is measured again once the vote lapses."""
    rests, hold = 1.2, 0.4
    somebody = walker((-0.8, 0.1, 2.4), (0.9, 0.0, 0.0), stop=rests)
    frames = play(*CHAIRS, somebody, seconds=2.6, overrides=(f"objects.static_mask.hold_dynamic_time={hold}",))
    walks = [frame[4] for frame in frames if 0.5 < frame.stamp < rests]
    assert {judged.motion_state for judged in walks} == {MotionState.DYNAMIC}
    assert all(math.isnan(judged.chamfer) for judged in walks)
    assert all(frame[4].motion_state is not MotionState.DYNAMIC or math.isnan(frame[4].chamfer) for frame in frames)
    assert all(frame[4].chamfer < 0.02 for frame in frames if frame.stamp > 2.4)


SHORT = ("objects.voting.baselines=[0.0, 0.3]", "objects.free_space.baselines=[0.3]")  # looks back 0.3 s and no more


@RATES
def test_a_verdict_holds_and_ends(rate: float) -> None:
    """The walk ends after 0.8 s; the last pair of views that shows it, 0.3 or 0.4 s apart, after 1.1 or 1.2 s."""
    thing = walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.8)
    frames = play(*CHAIRS, thing, seconds=2.4, rate=rate, overrides=(*SHORT, "objects.chamfer.enabled=false"))
    dynamic = [frame.stamp for frame in frames if frame[4].motion_state is MotionState.DYNAMIC]
    assert dynamic == [frame.stamp for frame in frames if dynamic[0] <= frame.stamp <= dynamic[-1]]
    assert 0.8 + 1.0 <= dynamic[-1] < 0.8 + 0.4 + 1.0 + 1e-6
    assert {frame[4].motion_state for frame in frames if frame.stamp > 2.25} == {MotionState.STATIC}


def test_a_verdict_holds_for_the_configured_time() -> None:
    thing = walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.6)
    short, long = (
        play(
            *CHAIRS,
            thing,
            seconds=1.7,
            overrides=(
                f"objects.static_mask.hold_dynamic_time={hold}",
                "objects.chamfer.enabled=false",
                *SHORT,
            ),
        )
        for hold in (0.2, 0.6)
    )
    ends = [max(frame.stamp for frame in run if frame[4].motion_state is MotionState.DYNAMIC) for run in (short, long)]
    assert ends[1] - ends[0] == pytest.approx(0.4, abs=1.01 / 15)  # a frame more or less by rounding


def flashing(t: float) -> list[Box]:
    """For a single frame its depth is wrong."""
    return [((-0.2, 0.3, 2.5 if abs(t - 0.6) > 0.01 else 2.0), (0.5, 0.6, 0.5))]


@pytest.mark.parametrize(("least", "label", "held"), [(3, PERSON, False), (2, PERSON, True), (2, CHAIR, False)])
def test_a_verdict_is_held_after_enough_frames_with_evidence_on_who_may_pause(
    least: int, label: int, held: bool
) -> None:
    """Two frames show a motion, though there was none: that in which the depth is wrong, and that 0.3 s later."""
    overrides = (
        f"objects.static_mask.confirm_dynamic_frames={least}",
        "objects.voting.baselines=[0.3]",
        "objects.chamfer.enabled=false",
    )
    frames = play(*CHAIRS, Thing(label, flashing), seconds=1.5, overrides=overrides)
    dynamic = [index for index, frame in enumerate(frames) if frame[4].motion_state is MotionState.DYNAMIC]
    # At 15 frames a second 0.3 s are 5 frames, and the second that a verdict is held 15.
    assert dynamic == ([9, *range(14, len(frames))] if held else [9, 14])


@RATES
def test_a_person_is_unknown_until_seen_still_for_long_enough(rate: float) -> None:
    """The background knows after its longest baseline, 0.9 s, or 1 s at 5 frames a second; without it it is 1 s."""
    things = (walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)), CHAIRS[0])
    for told, known in (("true", math.ceil(0.9 * rate) / rate), ("false", 1.0)):
        overrides = (f"objects.free_space.enabled={told}", "objects.chamfer.enabled=false")
        for frame in play(*things, seconds=1.4, rate=rate, camera=handheld, overrides=overrides):
            assert frame[1].motion_state is (MotionState.UNKNOWN if frame.stamp < known - 1e-9 else MotionState.STATIC)
            assert frame[2].motion_state is MotionState.STATIC


@pytest.mark.parametrize(("fitting", "motion_state"), [(1.0, MotionState.STATIC), (0.2, MotionState.UNKNOWN)])
def test_a_person_whose_features_fit_the_motion_is_none_or_stands(fitting: float, verdict: MotionState) -> None:
    """Rolled furniture over most of the image: at first sight all that tells are the features on it."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), 2.0)
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[:, :, : 3 * CAMERA.width // 4] = True
    person = Instances(mask, torch.tensor([PERSON]), torch.tensor([0.5]), torch.zeros(1, 4))
    rows, columns = torch.meshgrid(torch.arange(2, CAMERA.height, 6), torch.arange(2, CAMERA.width, 6), indexing="ij")
    pixel = torch.stack([columns.flatten(), rows.flatten()], dim=1)
    fits = torch.rand(len(pixel), generator=torch.Generator().manual_seed(0)) < 0.8
    on_person = mask[0, pixel[:, 1], pixel[:, 0]]
    fits[on_person] &= torch.rand(int(on_person.sum()), generator=torch.Generator().manual_seed(1)) < fitting
    stage = Stage(ObjectsConfig())
    stage.witnesses = FeatureSupport(pixel, fits)
    (judged,) = stage(0.0, person, depth, HERE).objects
    assert judged.motion_state is verdict


@pytest.mark.parametrize("label", [PERSON, DOG])
@pytest.mark.parametrize(("told", "motion_state"), [("true", MotionState.STATIC), ("false", MotionState.UNKNOWN)])
def test_what_stood_there_already_is_static_at_first_sight(label: int, told: str, verdict: MotionState) -> None:
    """The network finds it after 1 s only, when the background knows long since that nothing has come."""
    thing = walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0), label=label)
    overrides = (f"objects.free_space.enabled={told}",)
    frames = play(
        *CHAIRS, thing, seconds=1.1, camera=handheld, hidden=lambda t: {3} if t < 1.05 else set(), overrides=overrides
    )
    assert ids(frames[:-1]) == {1, 2, 3}
    assert frames[-1][4].motion_state is verdict


@pytest.mark.parametrize(("told", "motion_state"), [("true", MotionState.DYNAMIC), ("false", MotionState.UNKNOWN)])
def test_who_has_come_is_dynamic_at_first_sight(told: str, verdict: MotionState) -> None:
    """Nobody has a distance to an object that was not there before; the background saw that its place was empty."""
    thing = walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0))
    overrides = (NAMED_ONLY, f"objects.free_space.enabled={told}")
    frames = play(
        *CHAIRS, thing, seconds=0.6, camera=handheld, hidden=lambda t: {3} if t < 0.59 else set(), overrides=overrides
    )
    assert ids(frames[:-1]) == {1, 2, 3}
    assert frames[-1][4].motion_state is verdict
    assert frames[-1][4].votes == 0
    assert not frames[-1].scene.static_mask[frames[-1].owner == 3].any()


@CAMERAS
def test_a_walker_whom_the_network_never_finds_is_left_out_all_the_same(camera: Callable[[float], Tensor]) -> None:
    thing = walker((-0.8, 0.1, 2.3), (0.9, 0.0, 0.0))
    frames = play(*CHAIRS, thing, seconds=1.5, camera=camera, hidden=lambda _: {3})
    late = [frame for frame in frames if frame.stamp > 0.5]
    left_out = torch.cat([~frame.scene.static_mask[frame.owner == 3] for frame in late])
    assert float(left_out.double().mean()) > 0.9
    assert of_class(late, UNLABELLED) == {MotionState.DYNAMIC}
    away = [frame.scene.static_mask[away_from(frame.owner == 3) > 20] for frame in frames]
    assert torch.cat(away).all()
    assert of_class(frames, CHAIR) == of_class(frames, TV) == {MotionState.STATIC}


@pytest.mark.parametrize(
    ("score", "sightings", "motion_state"),
    [(0.2, 1, MotionState.STATIC), (0.2, 2, MotionState.UNKNOWN), (0.4, 1, MotionState.UNKNOWN)],
)
def test_what_was_seen_weakly_and_once_is_not_left_out_when_missed(
    score: float, sightings: int, verdict: MotionState
) -> None:
    things = (*CHAIRS, walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)))
    frames = play(*things, seconds=0.2, score=score, hidden=lambda t: {3} if 15 * t > sightings - 0.5 else set())
    for index, frame in enumerate(frames):
        assert frame[4].missed is (index >= sightings)
        assert frame[4].motion_state is (verdict if frame[4].missed else MotionState.UNKNOWN)
        usable = frame.scene.static_mask[frame.owner == 3]
        assert usable.all() if frame[4].motion_state is MotionState.STATIC else float(usable.double().mean()) < 0.05


def test_who_was_seen_weakly_but_moving_stays_left_out_when_missed() -> None:
    """Eleven sightings with scores of 0.02 are 0.22 together, less than the 0.3 of one who stands."""
    thing = walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0))
    hidden = {"score": 0.02, "hidden": lambda t: {3} if t > 0.69 else set()}
    frame = play(*CHAIRS, thing, seconds=0.8, overrides=(NAMED_ONLY,), **hidden)[-1]  # type: ignore[arg-type]
    assert frame[4].missed
    assert frame[4].motion_state is MotionState.DYNAMIC


def test_who_stopped_and_is_missed_where_he_stands_is_static_at_once() -> None:
    """The verdict of his walk would be held to the end: the last evidence is 0.9 s after it, 1 s is held."""
    thing = walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.5)
    frames = play(*CHAIRS, thing, seconds=1.7, hidden=lambda t: {3} if t > 1.55 else set())
    for frame in frames:
        if frame.stamp > 1.45:
            assert frame[4].missed is (frame.stamp > 1.55)
            assert frame[4].motion_state is (MotionState.STATIC if frame[4].missed else MotionState.DYNAMIC)


def test_the_static_mask_leaves_out_who_moves_or_might_up_to_the_seam_and_nothing_else() -> None:
    """What lies beside them is metres behind: the margin takes none of it, but for the seam of 2 pixels."""
    things = (*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)), swayer((1.0, 0.0, 2.0)))
    frame = play(*things, seconds=0.9)[-1]
    assert [frame[number].motion_state for number in (4, 5)] == [MotionState.DYNAMIC, MotionState.DEFORMING]
    late = play(*things, seconds=0.1)[-1]
    assert [late[number].motion_state for number in (4, 5)] == [MotionState.UNKNOWN, MotionState.UNKNOWN]
    for shown in (frame, late):
        away = away_from(shown.owner >= 3)
        assert not shown.scene.static_mask[away <= 1].any()  # a side seen as a sliver is no part of the cloud
        assert shown.scene.static_mask[away >= 3].all()
        # Chairs stay usable as well.
        assert int(((shown.owner >= 0) & (shown.owner < 3) & (away >= 3)).sum()) > 500


@pytest.mark.parametrize("grown", [-3, 4])
def test_the_outline_of_a_mover_follows_the_depth_and_not_the_mask(grown: int) -> None:
    """Too small a mask leaves his rim to the margin, too large a one takes a slice of the wall along."""
    frames = play(*CHAIRS[:2], walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)), seconds=0.6, grown=grown)
    for frame in frames:
        assert frame[3].motion_state is not MotionState.STATIC
        assert int((frame[3].mask ^ (frame.owner == 2)).sum()) > 250  # is drawn wrong indeed
        away = away_from(frame.owner == 2)
        assert not frame.scene.static_mask[away <= 1].any()  # a side seen as a sliver is no part of the cloud
        assert frame.scene.static_mask[away >= 3].all()


def test_the_margin_bounds_how_far_his_own_depth_is_followed() -> None:
    frame = play(
        *CHAIRS[:2],
        walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)),
        seconds=0.1,
        grown=-6,
        overrides=(
            "objects.static_mask.depth_margin=2",
            "objects.static_mask.surface_margin=0",
            "objects.static_mask.dilation=0",
        ),
    )[-1]
    own, away = frame.owner == 2, away_from(frame[3].mask)
    assert frame.scene.static_mask[own & (away >= 3)].all()
    assert float(frame.scene.static_mask[own & (away <= 2)].double().mean()) < 0.02
    assert int((own & (away >= 3)).sum()) > 100


def test_pixels_without_depth_beside_a_mover_are_left_out_within_the_margin() -> None:
    """Nobody knows whose they are: a structured-light camera loses the rim of what is near."""
    thing = walker((-0.1, 0.1, 2.3), (0.0, 0.0, 0.0))
    depth, owner = photograph([thing], 0.0, HERE, 0.0)
    away = away_from(owner == 0)
    depth[0, (away > 0) & (away < 20)] = 0.0
    stage = Stage(
        load_config(None, (STRIDE, "objects.static_mask.depth_margin=5", "objects.static_mask.dilation=0")).objects
    )
    static = stage(0.0, found(owner, [thing], set()), depth, HERE).static_mask
    assert not static[away <= 4].any()
    assert static[away >= 6].all()


def test_a_margin_and_a_seam_of_nothing_leave_out_the_object_itself() -> None:
    overrides = ("objects.static_mask.depth_margin=0", "objects.static_mask.dilation=0")
    frame = play(*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)), seconds=0.2, overrides=overrides)[-1]
    assert frame.scene.static_mask[frame.owner != 3].all()
    assert not frame.scene.static_mask[
        away_from(frame.owner != 3) > 1
    ].any()  # a side seen as a sliver is not in the cloud


def test_features_on_the_deforming_are_kept_when_asked_for() -> None:
    things = (*CHAIRS, swayer((0.0, 0.1, 2.4)))
    kept, left_out = (
        play(*things, seconds=0.8, overrides=(f"objects.chamfer.keep_deforming_features={include}",))[-1]
        for include in ("true", "false")
    )
    assert kept[4].motion_state is left_out[4].motion_state is MotionState.DEFORMING
    assert kept.scene.static_mask.all()
    assert not left_out.scene.static_mask[left_out.owner == 3].any()


def test_somebody_who_stands_is_tracked_on_but_not_mapped() -> None:
    things = (CHAIRS[0], walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)))
    scene = (frame := play(*things, seconds=1.2)[-1]).scene
    assert frame[2].motion_state is MotionState.STATIC
    assert scene.static_mask.all()
    away = away_from(frame.owner == 1)
    assert not scene.static_without_people[away <= 2].any()
    assert scene.static_without_people[away >= 3].all()


def test_a_missed_walker_goes_on_as_what_came_and_has_no_name() -> None:
    things = (*CHAIRS, walker((-0.8, 0.1, 2.3), (0.9, 0.0, 0.0)))
    frames = play(*things, seconds=1.6, hidden=lambda t: {3} if t > 0.65 else set())
    for frame in frames:
        if frame.stamp > 0.65:  # more than the half second that it would be predicted
            assert frame[4].motion_state is MotionState.DYNAMIC
            assert not frame[4].missed
            assert frame[4].label == PERSON  # as it was seen most of the time
            assert float((~frame.scene.static_mask)[frame.owner == 3].double().mean()) > 0.9
    assert ids(frames) == {1, 2, 3, 4}


def test_a_missed_walker_stays_left_out_where_it_must_be_and_is_then_forgotten() -> None:
    things = (*CHAIRS, walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0)))
    frames = play(*things, seconds=1.4, hidden=lambda t: {3} if t > 0.65 else set(), overrides=(NAMED_ONLY,))
    for frame in frames[:-1]:
        if 0.65 < frame.stamp < 1.1:
            assert frame[4].missed
            assert frame[4].motion_state is MotionState.DYNAMIC
            assert math.isnan(frame[4].chamfer)
            true_x = -0.6 + 0.9 * frame.stamp
            assert float(frame[4].centroid[0]) == pytest.approx(true_x, abs=0.1)
            left_out = (~frame.scene.static_mask)[frame.owner == 3]
            assert float(left_out.double().mean()) > 0.98
    assert 4 not in {judged.id for judged in frames[-1].scene.objects}
    assert frames[-1].scene.static_mask.all()


def test_without_voting_nothing_is_dynamic_and_without_chamfer_nothing_deforms() -> None:
    things = (*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)))
    no_voting = play(*things, seconds=0.5, overrides=("objects.voting.enabled=false",))
    assert MotionState.DYNAMIC not in verdicts(no_voting, 4)
    assert {frame[4].votes for frame in no_voting} == {0}
    no_chamfer = play(*CHAIRS, swayer((0.0, 0.1, 2.4)), seconds=0.8, overrides=("objects.chamfer.enabled=false",))
    assert MotionState.DEFORMING not in verdicts(no_chamfer, 4)
    assert all(math.isnan(frame[4].chamfer) for frame in no_chamfer)


@pytest.mark.parametrize("thing", [walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.1), stop=0.5), swayer((0.0, 0.1, 2.4))])
def test_verdicts_do_not_change_when_the_world_is_corrected_under_them(thing: Thing) -> None:
    T_new_old = se3_exp(torch.tensor([0.7, -0.2, 1.5, 0.2, -0.8, 0.4], dtype=torch.float64))
    overrides = ("objects.static_mask.hold_dynamic_time=0.2",)
    arguments = {"seconds": 1.2, "camera": handheld, "overrides": overrides}
    never = play(*CHAIRS, thing, **arguments)  # type: ignore[arg-type]
    then = play(*CHAIRS, thing, correction=(0.5, T_new_old), **arguments)  # type: ignore[arg-type]
    assert ids(never) == ids(then) == {1, 2, 3, 4}
    assert len(verdicts(never, 4)) > 1
    for old, new in zip(never, then, strict=True):
        for number in (1, 2, 3, 4):
            assert old[number].motion_state is new[number].motion_state
            assert old[number].votes == new[number].votes
            assert old[number].chamfer == pytest.approx(new[number].chamfer, abs=1e-5, nan_ok=True)
        T = HERE if new.stamp < 0.5 else T_new_old
        expected = T[:3, :3] @ old[4].centroid + T[:3, 3]
        torch.testing.assert_close(new[4].centroid, expected, rtol=0.0, atol=1e-5)


# The paper's literal rules, on centroids that are given: four objects on the corners of a rectangle of 0.6 m by 0.8 m.
CORNERS = torch.tensor([[0.0, 0.0, 2.0], [0.6, 0.0, 2.0], [0.0, 0.8, 2.0], [0.6, 0.8, 2.0]])


class Literal:
    """The object stage with configs/paper.yaml, shown a small ball of points at each of some places."""

    def __init__(self) -> None:
        config = load_config(PAPER).objects
        self._judge = MotionClassifier(config, CAMERA)
        self._watch = FreeSpaceCheck(config.free_space, CAMERA)
        self._frame = -1
        self.ballots: list[tuple[int, int]] = []

    def __call__(self, centroids: Tensor, T_wc: Tensor = HERE) -> dict[int, TrackedObject]:
        self._frame += 1
        count = len(centroids)
        ball = torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
        ball = 0.05 * (ball - ball.mean(dim=0))
        masks = torch.zeros(count, CAMERA.height, CAMERA.width, dtype=torch.bool)
        u, v = CAMERA.project(centroids).round().long().unbind(dim=1)
        for mask, column, row in zip(masks, u.tolist(), v.tolist(), strict=True):
            mask[row - 4 : row + 5, column - 4 : column + 5] = True
        clouds = InstanceClouds(centroids[:, None] + ball, torch.ones(count, 64, dtype=torch.bool), centroids, masks)
        instances = Instances(masks, torch.full((count,), CHAIR), torch.ones(count), torch.zeros(count, 4))
        view = DepthView(self._frame / 30, torch.full((1, CAMERA.height, CAMERA.width), WALL), invert(T_wc))
        scene = self._judge(instances, clouds, view, self._watch(view), NO_WITNESSES)
        self._watch.remember(view)
        self.ballots = scene.vote_pairs
        return {judged.id: judged for judged in scene.objects}


def test_literal_rules_equal_algorithm_1_by_hand() -> None:
    """A moves 0.1 m towards C. Distances of A: to B 0.6 -> 0.608, to C 0.8 -> 0.7, to D 1.0 -> 0.922.

    With T_d = 0.05 m that is a vote each between A and C, and A and D; with T_v = 2 only A, who has both, is dynamic.
    """
    show = Literal()
    assert {judged.votes for judged in show(CORNERS).values()} == {0}
    moved = CORNERS.clone()
    moved[0, 1] = 0.1
    judged = show(moved)
    assert {number: judged[number].votes for number in judged} == {1: 2, 2: 0, 3: 1, 4: 1}
    assert show.ballots == [(1, 3), (1, 4), (3, 1), (4, 1)]  # who voted, for whom
    for number, place in enumerate(moved, start=1):
        torch.testing.assert_close(judged[number].cloud.mean(dim=0), place, rtol=0.0, atol=1e-5)
    assert [judged[number].motion_state is MotionState.DYNAMIC for number in (1, 2, 3, 4)] == [
        True,
        False,
        False,
        False,
    ]
    # Consecutive frames only, and a verdict for its frame only: in the next, where all stand, nobody moves.
    judged = show(moved)
    assert {judged[number].votes for number in judged} == {0} and show.ballots == []
    assert {judged[number].motion_state for number in judged} == {MotionState.STATIC}


def test_literal_rules_let_two_movers_outvote_the_others() -> None:
    """A and D go 0.1 m up and down: B and C get a vote of each, two in all, and are taken for dynamic as well.

    Distances: AB 0.6 -> 0.608, AC 0.8 -> 0.9, AD 1.0 -> 1.166, BD 0.8 -> 0.9, CD 0.6 -> 0.608, BC as it was. So A and
    D have two votes, B and C one. With A also 0.1 m to the left: AB 0.7071, AC 0.906: two votes for B and C.
    """
    show = Literal()
    show(CORNERS)
    moved = CORNERS.clone()
    moved[0, 1] -= 0.1
    moved[3, 1] += 0.1
    judged = show(moved)
    assert [judged[number].votes for number in (1, 2, 3, 4)] == [2, 1, 1, 2]
    show = Literal()
    show(CORNERS)
    moved[0, 0] -= 0.1
    moved[3, 0] += 0.1
    judged = show(moved)
    assert [judged[number].votes for number in (1, 2, 3, 4)] == [3, 2, 2, 3]
    assert {judged[number].motion_state for number in judged} == {MotionState.DYNAMIC}


def test_literal_rules_need_no_pose() -> None:
    """The camera is said to have moved when it has not: no distance between two objects changes."""
    wrong = se3_exp(torch.tensor([0.06, 0.02, -0.05, 0.02, 0.03, -0.05], dtype=torch.float64))
    show = Literal()
    show(CORNERS)
    judged = show(CORNERS, wrong)
    assert [judged[number].votes for number in (1, 2, 3, 4)] == [0, 0, 0, 0]
    assert MotionState.DYNAMIC not in {judged[number].motion_state for number in judged}


def test_literal_rules_give_no_vote_to_what_the_frame_before_has_not() -> None:
    """Algorithm 1 compares keys of both frames. A moved while the network missed it."""
    show = Literal()
    show(CORNERS)
    show(CORNERS[1:])
    moved = CORNERS.clone()
    moved[0, 1] = 0.1
    judged = show(moved)
    assert [judged[number].votes for number in (1, 2, 3, 4)] == [0, 0, 0, 0]


def test_where_the_background_cannot_tell_nothing_is_dynamic() -> None:
    """A box steps on by 6 cm a frame while the depth of all images is lost, so that no place can be looked at."""
    stage = Stage(load_config(None, (STRIDE,)).objects)
    nothing = torch.zeros(1, CAMERA.height, CAMERA.width)
    for frame in range(12):
        things = [still((0.06 * frame - 0.3, 0.2, 3.0)), still((0.8, 0.2, 3.0))]
        depth, owner = photograph(things, frame / 30, HERE, 0.0)
        scene = stage(frame / 30, found(owner, things, set()), nothing, HERE, lifted=depth)
        assert [judged.motion_state for judged in scene.objects] == [MotionState.STATIC, MotionState.STATIC]


def test_nothing_to_see() -> None:
    frames = play(seconds=0.2)
    assert all(frame.scene.objects == [] for frame in frames)
    assert all(frame.scene.static_mask.all() for frame in frames)
    assert frames[0].scene.static_mask.shape == (CAMERA.height, CAMERA.width)


def test_objects_without_depth_are_static_things_and_unknown_people() -> None:
    stage = Stage(load_config(None, (STRIDE,)).objects)
    things = [CHAIRS[0], walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0))]
    for frame in range(12):
        _, owner = photograph(things, 0.0, HERE, 0.0)
        nothing = torch.zeros(1, CAMERA.height, CAMERA.width)
        scene = stage(frame / 30, found(owner, things, set()), nothing, HERE)
        assert [judged.motion_state for judged in scene.objects] == [MotionState.STATIC, MotionState.UNKNOWN]
        assert all(torch.isnan(judged.centroid).all() and math.isnan(judged.chamfer) for judged in scene.objects)
        assert not scene.static_mask[owner == 1].any()


def test_hundred_objects_of_which_one_moves() -> None:
    """Every 0.2 m a box of 0.14 m in a plane at 2 m; the one in the middle goes towards the camera."""
    places = [(0.22 * c - 1.0, 0.17 * r - 0.77) for r in range(10) for c in range(10)]
    things = [still((x, y, 2.0), (0.17, 0.13, 0.02), TV) for x, y in places]
    x, y = places[44]
    things[44] = Thing(TV, lambda t: [((x, y, 2.0 - 0.9 * t), (0.17, 0.13, 0.02))])
    overrides = ("objects.free_space.min_points=4",)  # of the smaller images: a box has 6 of every 4th pixel
    frames = play(*things, seconds=0.4, rate=10.0, noise=0.0, overrides=overrides)
    assert ids(frames) == set(range(1, 101))
    moving = {judged.id for judged in frames[-1].scene.objects if judged.motion_state is not MotionState.STATIC}
    assert moving == {45}


def test_equal_stamps_are_taken_in() -> None:
    stage = Stage(ObjectsConfig.model_validate({"clouds": {"stride": 1}}))
    for _ in range(3):
        depth, owner = photograph(list(CHAIRS), 0.0, handheld(0.3), 0.0)
        scene = stage(5.0, found(owner, list(CHAIRS), set()), depth, handheld(0.3))
        assert [judged.id for judged in scene.objects] == [1, 2, 3]
        assert {judged.motion_state for judged in scene.objects} == {MotionState.STATIC}


def test_same_bytes_again() -> None:
    things = (*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.1)))
    first_run, second_run = (play(*things, seconds=0.5, camera=handheld) for _ in range(2))
    no_tensors: dict[str, Any] = dict.fromkeys(("mask", "centroid", "cloud"))
    for a, b in zip(first_run, second_run, strict=True):
        assert torch.equal(a.scene.static_mask, b.scene.static_mask)
        for one, other in zip(a.scene.objects, b.scene.objects, strict=True):
            assert one.centroid.numpy().tobytes() == other.centroid.numpy().tobytes()
            assert one.cloud.numpy().tobytes() == other.cloud.numpy().tobytes()
            assert replace(one, **no_tensors) == replace(other, **no_tensors) or (
                math.isnan(one.chamfer) and math.isnan(other.chamfer) and one.motion_state is other.motion_state
            )
