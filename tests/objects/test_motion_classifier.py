"""Motion classification in rooms of boxes with ground truth: walkers, swaying people, and apparent motion."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from helpers.differences import differences
from helpers.object_scenes import NO_FEATURES, ObjectStage, support_without_residuals
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from v3d_torch.config import ObjectsConfig
from v3d_torch.config.loading import find_config, load_config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.feature_support import FeatureSupport
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.objects.free_space_check import FreeSpaceCheck
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.motion_classifier import MotionClassifier
from v3d_torch.segmentation.coco import PERSON, UNLABELLED
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
STRIDE = "objects.clouds.stride=1"  # a quarter of the usual resolution
NO_UNLABELLED = "objects.free_space.min_unlabelled_area=100.0"  # square metres: no unlabelled instances
PAPER = find_config("paper")
HERE = torch.eye(4, dtype=torch.float64)
WALL = 5.0
DOG, CHAIR, TV = 16, 56, 62
MIN_PIXELS = 25  # smallest object that the network detects

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]  # centre and size, metres, along the axes of the world


@dataclass(frozen=True)
class Thing:
    """Object made of boxes that can move: ``boxes`` is a function of time in seconds."""

    label: int
    boxes: Callable[[float], list[Box]]


def static_box(centre: Vector, size: Vector = (0.5, 0.6, 0.5), label: int = CHAIR) -> Thing:
    return Thing(label, lambda _: [(centre, size)])


def walker(start: Vector, velocity: Vector, stop: float = math.inf, label: int = PERSON) -> Thing:
    """Person 1.5 m tall who walks until ``stop`` seconds."""

    def boxes(t: float) -> list[Box]:
        t = min(t, stop)
        x, y, z = (s + v * t for s, v in zip(start, velocity, strict=True))
        return [((x, y, z), (0.4, 1.5, 0.3))]

    return Thing(label, boxes)


def swaying_person(centre: Vector) -> Thing:
    """Person who moves both arms symmetrically, once in 1.2 s: the centroid stays in place."""

    def boxes(t: float) -> list[Box]:
        x, y, z = centre
        reach = 0.02 + 0.3 * (0.5 - 0.5 * math.cos(2 * math.pi * t / 1.2))
        return [((x, y, z), (0.35, 1.0, 0.25)), ((x, y, z), (0.35 + 2 * reach, 0.4, 0.2))]

    return Thing(PERSON, boxes)


CHAIRS = (static_box((-1.1, 0.4, 2.8)), static_box((1.1, 0.3, 3.2)), static_box((0.2, -0.7, 4.2), (0.8, 0.5, 0.2), TV))


def render(things: list[Thing], t: float, T_wc: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Return the noisy depth of a structured-light camera, (1, H, W), and the thing at each pixel, -1 = the wall."""
    origin = T_wc[:3, 3]
    rays = CAMERA.rays.double() @ T_wc[:3, :3].T  # of unit depth: a distance along them is a depth
    direction = rays.permute(2, 0, 1).contiguous()  # of each axis an image: their extremes take less time
    depth = (WALL - origin[2]) / direction[2]
    owner = torch.full(depth.shape, -1)
    for i, thing in enumerate(things):
        for centre, size in thing.boxes(t):
            middle, half = (torch.tensor(vector, dtype=torch.float64) for vector in (centre, size))
            low, high = ((corner - origin)[:, None, None] for corner in (middle - half / 2, middle + half / 2))
            a, b = low / direction, high / direction
            enters, leaves = torch.minimum(a, b).amax(dim=0), torch.maximum(a, b).amin(dim=0)
            hit = (enters <= leaves) & (enters > 0.1) & (enters < depth)
            depth[hit], owner[hit] = enters[hit], i
    generator = torch.Generator().manual_seed(round(1000 * t))
    error = noise * depth.square() * torch.randn(depth.shape, generator=generator, dtype=torch.float64)
    return (depth + error)[None].float(), owner


def detect(owner: Tensor, things: list[Thing], hidden: set[int], score: float = 1.0) -> Instances:
    """Return the instances of a network that misses ``hidden`` things and all small ones, with a given score."""
    seen = [i for i in range(len(things)) if i not in hidden and int((owner == i).sum()) >= MIN_PIXELS]
    if not seen:
        return Instances.empty(CAMERA.height, CAMERA.width)
    labels = torch.tensor([things[i].label for i in seen])
    masks = torch.stack([owner == i for i in seen])
    return Instances(masks, labels, torch.full((len(seen),), score), torch.zeros(len(seen), 4))


def distance_to(mask: Tensor) -> Tensor:
    """Return the distance to the nearest pixel of a mask, 0 inside, pixels."""
    return torch.from_numpy(distance_transform_edt(~mask))


def static_camera(_: float) -> Tensor:
    return HERE


def handheld(t: float) -> Tensor:
    """0.4 m/s sideways, 0.15 m/s forward, and 0.2 rad/s of turning."""
    return se3_exp(
        torch.tensor([0.4 * t - 0.2, 0.05 * math.sin(6 * t), 0.15 * t, 0.03, 0.15 - 0.2 * t, 0.02 * t]).double()
    )


@dataclass(frozen=True)
class Frame:
    """Ground truth of a frame and the result of the object stage."""

    stamp: float
    owner: Tensor
    result: FrameObjects

    def __getitem__(self, number: int) -> TrackedObject:
        """Return the object with this id: if all things are detected at the start, they have the ids 1, 2, 3 ..."""
        (obj,) = [obj for obj in self.result.objects if obj.id == number]
        return obj


def simulate(
    *things: Thing,
    seconds: float,
    rate: float = 15.0,
    camera: Callable[[float], Tensor] = static_camera,
    overrides: tuple[str, ...] = (),
    path: Path | None = None,
    hidden: Callable[[float], set[int]] = lambda _: set(),
    score: float = 1.0,
    mask_growth: float = 0.0,
    noise: float = 0.0014,
    correction: tuple[float, Tensor] | None = None,
) -> list[Frame]:
    """Run the object stage on moving things.

    Args:
        things: Things in the room.
        seconds: Length of the run, seconds.
        rate: Frame rate, Hz.
        camera: Camera-to-world pose at a time in seconds.
        overrides: Overrides of the configuration.
        path: Configuration file.
        hidden: Things that the network misses at a time in seconds.
        score: Score of all detections.
        mask_growth: Distance by which the network draws its masks too large, pixels; too small if negative.
        noise: Depth noise, 1/m.
        correction: Time of a correction of the world, seconds, and the correction.
    """
    stage = ObjectStage(load_config(path, (STRIDE, *overrides)).objects)
    T_new_old, frames = HERE, []
    for index in range(round(seconds * rate) + 1):
        t = index / rate
        if correction is not None and T_new_old is HERE and t >= correction[0]:
            T_new_old = correction[1]
            stage.move_world(T_new_old)
        depth, owner = render(list(things), t, camera(t), noise)
        named = detect(owner, list(things), hidden(t), score)
        drawn = (
            torch.stack([distance_to(mask) - distance_to(~mask) <= mask_growth for mask in named.masks])
            if mask_growth
            else named.masks
        )
        result = stage(t, replace(named, masks=drawn), depth, T_new_old @ camera(t))
        frames.append(Frame(t, owner, result))
    return frames


def motion_states(frames: list[Frame], number: int) -> set[MotionState]:
    return {obj.motion_state for frame in frames for obj in frame.result.objects if obj.id == number}


def states_of_class(frames: list[Frame], label: int, *but: int) -> set[MotionState]:
    """Return the motion states of a class except for some ids: an object that reappears can have a new id."""
    objects = [obj for frame in frames for obj in frame.result.objects]
    return {obj.motion_state for obj in objects if obj.label == label and obj.id not in but}


def first_time(frames: list[Frame], number: int, motion_state: MotionState) -> float:
    """Return the first time at which an object has a motion state, seconds."""
    return next((frame.stamp for frame in frames if frame[number].motion_state is motion_state), math.inf)


def ids(frames: list[Frame]) -> set[int]:
    return {obj.id for frame in frames for obj in frame.result.objects}


RATES = pytest.mark.parametrize("rate", [5.0, 30.0])
CAMERAS = pytest.mark.parametrize("camera", [static_camera, handheld])


@RATES
@CAMERAS
def test_walker_is_the_only_dynamic_object(rate: float, camera: Callable[[float], Tensor]) -> None:
    """0.9 m/s is 3 cm per frame at 30 Hz, no more than the noise; the walker is dynamic within 0.4 s."""
    frames = simulate(*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.1)), seconds=1.0, rate=rate, camera=camera)
    assert first_time(frames, 4, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert frames[-1][4].motion_state is MotionState.DYNAMIC
    assert frames[-1][4].votes >= 2
    vote_pairs = {pair for frame in frames for pair in frame.result.vote_pairs}
    assert any(candidate == 4 for _, candidate in vote_pairs) and 4 not in {voter for voter, _ in vote_pairs}
    assert {4} == {obj.id for frame in frames for obj in frame.result.objects if obj.label == PERSON}
    assert states_of_class(frames, CHAIR) == states_of_class(frames, TV) == {MotionState.STATIC}


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.9), (0.0, 0.0, -0.6), (0.5, 0.0, 0.7)])
def test_walker_along_the_line_of_sight_is_dynamic(velocity: Vector) -> None:
    frames = simulate(*CHAIRS, walker((-0.2, 0.1, 2.2), velocity), seconds=0.6)
    assert first_time(frames, 4, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert all(motion_states(frames, number) == {MotionState.STATIC} for number in (1, 2, 3))


@CAMERAS
@pytest.mark.parametrize("second", [(-0.8, 0.0, 0.0), (0.8, 0.0, 0.3)])
def test_two_walkers_do_not_outvote_static_chairs(camera: Callable[[float], Tensor], second: Vector) -> None:
    start = (0.5, 0.0, 3.4) if second[0] < 0 else (-0.9, 0.0, 3.4)
    things = (*CHAIRS[:2], walker((-0.4, 0.1, 2.2), (0.8, 0.0, 0.0)), walker(start, second))
    frames = simulate(*things, seconds=0.8, camera=camera)
    assert ids(frames) == {1, 2, 3, 4}
    assert first_time(frames, 3, MotionState.DYNAMIC) <= 0.45
    assert first_time(frames, 4, MotionState.DYNAMIC) <= 0.6  # it is occluded for a while
    assert motion_states(frames, 1) == motion_states(frames, 2) == {MotionState.STATIC}
    # Each walker's distance to each chair changes, but moving objects do not vote: the chairs have no votes.
    assert {frame[number].votes for frame in frames for number in (1, 2)} == {0}


@CAMERAS
def test_single_object_is_classified_by_free_space(camera: Callable[[float], Tensor]) -> None:
    """No other object can vote: the free-space check decides."""
    walking = simulate(walker((-0.5, 0.1, 2.5), (0.9, 0.0, 0.0)), seconds=0.6, camera=camera)
    assert first_time(walking, 1, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert motion_states(simulate(CHAIRS[0], seconds=1.2, camera=camera), 1) == {MotionState.STATIC}


@pytest.mark.parametrize("label", [CHAIR, PERSON])
def test_object_occluded_by_a_walker_is_not_dynamic(label: int) -> None:
    """The object is occluded from one side to the other: its centroid jumps in every frame."""
    standing_still = static_box((0.2, 0.3, 3.2), (0.9, 0.7, 0.4), label)
    frames = simulate(standing_still, CHAIRS[0], walker((-0.45, 0.1, 2.0), (1.0, 0.0, 0.0)), seconds=1.3)
    pixels = [int((frame.owner == 0).sum()) for frame in frames]
    assert 50 < min(pixels) < 0.5 * pixels[0]
    shown = [obj for frame in frames for obj in frame.result.objects if obj.label == label and obj.id != 3]
    x = torch.tensor([float(obj.centroid[0]) for obj in shown if label == PERSON or obj.id != 2])
    assert float((x - x[0]).abs().max()) > 0.15
    assert states_of_class(frames, CHAIR) == {MotionState.STATIC}
    assert states_of_class(frames, PERSON, 3) <= {MotionState.UNKNOWN, MotionState.STATIC}
    assert frames[-1][3].motion_state is MotionState.DYNAMIC


@pytest.mark.parametrize("label", [CHAIR, PERSON])
def test_object_cut_by_the_image_border_is_not_dynamic(label: int) -> None:
    """0.6 rad/s: the wide box leaves the image, and its centroid moves along the box."""

    def turning(t: float) -> Tensor:
        return se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.6 * t, 0.0], dtype=torch.float64))

    wide = static_box((-0.8, 0.3, 2.6), (1.0, 0.4, 0.6), label)
    frames = simulate(wide, CHAIRS[1], static_box((0.4, -0.5, 3.5)), seconds=0.9, camera=turning)
    assert int((frames[-1].owner == 0).sum()) < 0.4 * int((frames[0].owner == 0).sum())
    centroids = [obj.centroid for frame in frames for obj in frame.result.objects if obj.id == 1]
    assert float((centroids[-1] - centroids[0]).norm()) > 0.15
    assert motion_states(frames, 1) == {
        MotionState.STATIC if label == CHAIR else MotionState.UNKNOWN
    }  # less than a second of evidence
    assert motion_states(frames, 2) == motion_states(frames, 3) == {MotionState.STATIC}


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.3), (0.9, 0.0, 0.0)])
def test_pushed_chair_is_dynamic(velocity: Vector) -> None:
    """Rigid things are dynamic only if they vacate their places."""
    x, y, z = velocity
    pushed = Thing(CHAIR, lambda t: [((-0.4 + x * t, 0.3 + y * t, 2.5 + z * t), (0.5, 0.6, 0.5))])
    frames = simulate(*CHAIRS, pushed, seconds=0.8)
    assert first_time(frames, 4, MotionState.DYNAMIC) <= 0.4 + 1e-6
    assert all(motion_states(frames, number) == {MotionState.STATIC} for number in (1, 2, 3))


def test_slowly_pushed_chair_is_dynamic_within_a_second() -> None:
    """0.4 m/s: the chair vacates a quarter of its half metre in 0.3 s, and four fifths in a second."""
    pushed = Thing(CHAIR, lambda t: [((-0.6 + 0.4 * t, 0.3, 2.2), (0.5, 0.6, 0.5))])
    frames = simulate(*CHAIRS, pushed, seconds=1.4)
    assert all(motion_states(frames, number) == {MotionState.STATIC} for number in (1, 2, 3))
    assert first_time(frames, 4, MotionState.DYNAMIC) <= 1.1


@CAMERAS
def test_swaying_person_is_deforming_and_not_dynamic(camera: Callable[[float], Tensor]) -> None:
    frames = simulate(*CHAIRS, swaying_person((0.0, 0.1, 2.4)), seconds=2.0, camera=camera)
    assert MotionState.DYNAMIC not in motion_states(frames, 4)
    assert first_time(frames, 4, MotionState.DEFORMING) <= 0.6
    assert {frame[4].motion_state for frame in frames if frame.stamp > 0.6} == {MotionState.DEFORMING}
    assert max(frame[4].chamfer for frame in frames if frame.stamp >= 0.3) > 0.025
    for number in (1, 2, 3):
        assert motion_states(frames, number) == {MotionState.STATIC}


def test_chamfer_of_standing_person_is_noise_and_of_things_is_nan() -> None:
    things = (*CHAIRS, walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)))
    frames = simulate(*things, seconds=0.8, camera=handheld)
    assert all(math.isnan(frame[4].chamfer) for frame in frames if frame.stamp < 0.29)
    assert all(0 < frame[4].chamfer < 0.02 for frame in frames if frame.stamp > 0.31)
    assert all(math.isnan(frame[number].chamfer) for frame in frames for number in (1, 2, 3))


def test_chamfer_is_measured_only_if_the_vote_is_static() -> None:
    """A walking person is dynamic and not compared; a person at rest is compared again when the dynamic state ends."""
    rests, hold = 1.2, 0.4
    somebody = walker((-0.8, 0.1, 2.4), (0.9, 0.0, 0.0), stop=rests)
    frames = simulate(*CHAIRS, somebody, seconds=2.6, overrides=(f"objects.static_mask.hold_dynamic_time={hold}",))
    walks = [frame[4] for frame in frames if 0.5 < frame.stamp < rests]
    assert {obj.motion_state for obj in walks} == {MotionState.DYNAMIC}
    assert all(math.isnan(obj.chamfer) for obj in walks)
    assert all(frame[4].motion_state is not MotionState.DYNAMIC or math.isnan(frame[4].chamfer) for frame in frames)
    assert all(frame[4].chamfer < 0.02 for frame in frames if frame.stamp > 2.4)


SHORT = ("objects.voting.time_spans=[0.0, 0.3]", "objects.free_space.time_spans=[0.3]")  # compares over 0.3 s only


@RATES
def test_dynamic_state_is_held_and_ends(rate: float) -> None:
    """The walk ends after 0.8 s. The last pair of views that shows motion, 0.3 or 0.4 s apart, is at 1.1 or 1.2 s."""
    thing = walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.8)
    frames = simulate(*CHAIRS, thing, seconds=2.4, rate=rate, overrides=(*SHORT, "objects.chamfer.enabled=false"))
    dynamic = [frame.stamp for frame in frames if frame[4].motion_state is MotionState.DYNAMIC]
    assert dynamic == [frame.stamp for frame in frames if dynamic[0] <= frame.stamp <= dynamic[-1]]
    assert 0.8 + 1.0 <= dynamic[-1] < 0.8 + 0.4 + 1.0 + 1e-6
    assert {frame[4].motion_state for frame in frames if frame.stamp > 2.25} == {MotionState.STATIC}


def test_dynamic_state_is_held_for_the_configured_time() -> None:
    thing = walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.6)
    short, long = (
        simulate(
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
    assert ends[1] - ends[0] == pytest.approx(0.4, abs=1.01 / 15)  # one frame of rounding


def test_chair_that_stopped_is_static_at_once_although_motion_over_a_longer_time_is_unknown() -> None:
    """It was pushed for 0.8 s; no view is 5 s older than another."""
    chair = walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.8, label=CHAIR)
    overrides = ("objects.voting.time_spans=[0.0, 0.3]", "objects.free_space.time_spans=[0.3, 5.0]")
    frames = simulate(*CHAIRS, chair, seconds=1.5, overrides=overrides)
    dynamic = [frame.stamp for frame in frames if frame[4].motion_state is MotionState.DYNAMIC]
    assert 0.8 <= dynamic[-1] < 0.8 + 0.4 + 1e-6


def flashing(t: float) -> list[Box]:
    """Box with a wrong depth in a single frame."""
    return [((-0.2, 0.3, 2.5 if abs(t - 0.6) > 0.01 else 2.0), (0.5, 0.6, 0.5))]


@pytest.mark.parametrize(("min_frames", "label", "held"), [(3, PERSON, False), (2, PERSON, True), (2, CHAIR, False)])
def test_dynamic_state_of_living_object_is_held_after_enough_evidence(min_frames: int, label: int, held: bool) -> None:
    """Two frames stage a false motion: the frame with the wrong depth, and the frame 0.3 s later."""
    overrides = (
        f"objects.static_mask.confirm_dynamic_frames={min_frames}",
        "objects.voting.time_spans=[0.3]",
        "objects.chamfer.enabled=false",
    )
    frames = simulate(*CHAIRS, Thing(label, flashing), seconds=1.5, overrides=overrides)
    dynamic = [index for index, frame in enumerate(frames) if frame[4].motion_state is MotionState.DYNAMIC]
    # At 15 Hz, 0.3 s are 5 frames, and the state is held for 15 frames.
    assert dynamic == ([9, *range(14, len(frames))] if held else [9, 14])


@RATES
def test_standing_person_is_unknown_before_static(rate: float) -> None:
    """The free-space check decides after its longest time span, 0.9 s, or 1 s at 5 Hz; without it after 1 s."""
    things = (walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)), CHAIRS[0])
    for enabled, known in (("true", math.ceil(0.9 * rate) / rate), ("false", 1.0)):
        overrides = (f"objects.free_space.enabled={enabled}", "objects.chamfer.enabled=false")
        for frame in simulate(*things, seconds=1.4, rate=rate, camera=handheld, overrides=overrides):
            assert frame[1].motion_state is (MotionState.UNKNOWN if frame.stamp < known - 1e-9 else MotionState.STATIC)
            assert frame[2].motion_state is MotionState.STATIC


@pytest.mark.parametrize(("second", "motion_state"), [(PERSON, MotionState.UNKNOWN), (CHAIR, MotionState.STATIC)])
def test_new_object_that_was_detected_as_a_person_once_is_unknown(second: int, motion_state: MotionState) -> None:
    depth, owner = render([walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0))], 0.0, HERE, noise=0.0)
    stage = ObjectStage(load_config(None, (STRIDE,)).objects)
    for frame, label in enumerate((CHAIR, second, CHAIR, CHAIR)):
        instances = detect(owner, [static_box((0.0, 0.0, 0.0), label=label)], set())
        (obj,) = stage(frame / 15, instances, depth, HERE).objects
    assert (obj.label, obj.motion_state) == (CHAIR, motion_state)


@pytest.mark.parametrize(
    ("fitting", "interruption", "motion_state"),
    [(1.0, None, MotionState.STATIC), (0.2, None, MotionState.UNKNOWN), (1.0, 4, MotionState.UNKNOWN)],
)
def test_person_with_supporting_features_is_static_after_a_third_of_a_second(
    fitting: float, interruption: int | None, motion_state: MotionState
) -> None:
    """Rotated furniture over most of the image: the features on it are evidence before the free-space check is.

    A person who walks slowly or towards the camera has features that fit between two frames. The interruption is the
    index of a frame in which no feature on the person fits.
    """
    depth = torch.full((1, CAMERA.height, CAMERA.width), 2.0)
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[:, :, : 3 * CAMERA.width // 4] = True
    person = Instances(mask, torch.tensor([PERSON]), torch.tensor([0.5]), torch.zeros(1, 4))
    rows, columns = torch.meshgrid(torch.arange(2, CAMERA.height, 6), torch.arange(2, CAMERA.width, 6), indexing="ij")
    pixel = torch.stack([columns.flatten(), rows.flatten()], dim=1)
    fits = torch.rand(len(pixel), generator=torch.Generator().manual_seed(0)) < 0.8
    on_person = mask[0, pixel[:, 1], pixel[:, 0]]
    fits[on_person] &= torch.rand(int(on_person.sum()), generator=torch.Generator().manual_seed(1)) < fitting
    stage = ObjectStage(ObjectsConfig())
    for frame in range(9):
        stage.feature_support = support_without_residuals(pixel, fits & ~on_person if frame == interruption else fits)
        (obj,) = stage(frame / 30, person, depth, HERE).objects
        assert obj.motion_state is MotionState.UNKNOWN
    (obj,) = stage(9 / 30, person, depth, HERE).objects
    assert obj.motion_state is motion_state


@pytest.mark.parametrize(
    ("step", "enabled", "since"),
    [(1.0, "true", 3), (0.1, "true", None), (1.0, "false", None)],
    ids=["moving", "noise", "without features"],
)
def test_thing_whose_features_shift_is_dynamic_until_they_have_not_for_a_second(
    step: float, enabled: str, since: int | None
) -> None:
    """A screen moves along its own plane: its depth does not change, so that only features show the motion.

    In one frame its features move by ``step`` pixels; they are not matched while it is masked.
    """
    depth = torch.full((1, CAMERA.height, CAMERA.width), 2.0)
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[:, 30:90, 50:110] = True
    screen = Instances(mask, torch.tensor([62]), torch.tensor([0.9]), torch.zeros(1, 4))
    pixel = torch.cartesian_prod(torch.arange(2, CAMERA.width, 5), torch.arange(2, CAMERA.height, 5))
    residuals = torch.zeros(len(pixel), 2, dtype=torch.float64)
    residuals[mask[0, pixel[:, 1], pixel[:, 0]], 0] = step
    fits = torch.ones(len(pixel), dtype=torch.bool)
    stage = ObjectStage(load_config(None, (f"objects.feature_shift.enabled={enabled}",)).objects)
    dynamic = []
    for frame in range(50):
        seen = torch.where((residuals != 0) & (frame > 8), torch.nan, residuals)
        stage.feature_support = FeatureSupport(pixel, fits, seen)
        (obj,) = stage(frame / 30, screen, depth, HERE).objects
        dynamic.append(obj.motion_state is MotionState.DYNAMIC)
    expected = range(0) if since is None else range(since, 8 + 31)
    assert [frame for frame in range(50) if dynamic[frame]] == list(expected)


@pytest.mark.parametrize(
    ("label", "share", "motion_state"),
    [(60, 0.6, MotionState.STATIC), (60, 0.4, MotionState.DYNAMIC), (PERSON, 0.6, MotionState.DYNAMIC)],
    ids=["table", "table with few features", "person"],
)
def test_thing_with_most_inliers_of_the_camera_motion_is_static(
    label: int, share: float, motion_state: MotionState
) -> None:
    """The depth shows a motion of the object. The camera motion, measured from its features, shows none."""
    features = torch.cartesian_prod(torch.arange(2, CAMERA.width, 5), torch.arange(2, CAMERA.height, 5))
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[:, 30:90, 50:110] = True
    thing = Instances(mask, torch.tensor([label]), torch.tensor([0.9]), torch.zeros(1, 4))
    on_thing = mask[0, features[:, 1], features[:, 0]]
    others = (~on_thing).nonzero()[:, 0][: round(int(on_thing.sum()) * (1 - share) / share)]
    fits = on_thing.clone()
    fits[others] = True
    stage = ObjectStage(ObjectsConfig())
    stage.feature_support = support_without_residuals(features, fits)
    for frame in range(40):
        depth = torch.full((1, CAMERA.height, CAMERA.width), 3.0)
        depth[mask] = 2.0 - 0.02 * frame
        (obj,) = stage(frame / 30, thing, depth, HERE).objects
    assert obj.motion_state is motion_state


def test_thing_is_static_although_something_in_its_mask_moves() -> None:
    """The mask of a table contains an arm before it, on which most of its features are."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), 2.0)
    depth[:, 30:60, 50:80] = 1.0
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[:, 30:90, 50:110] = True
    table = Instances(mask, torch.tensor([60]), torch.tensor([0.9]), torch.zeros(1, 4))
    pixel = torch.cartesian_prod(torch.arange(2, CAMERA.width, 5), torch.arange(2, CAMERA.height, 5))
    on_arm = depth[0, pixel[:, 1], pixel[:, 0]] == 1.0
    on_table = mask[0, pixel[:, 1], pixel[:, 0]] & ~on_arm
    on_table[::6] = False
    pixel, on_arm = pixel[~on_table], on_arm[~on_table]
    residuals = torch.zeros(len(pixel), 2, dtype=torch.float64)
    residuals[on_arm, 0] = 1.0
    stage = ObjectStage(load_config(None, ()).objects)
    for frame in range(15):
        stage.feature_support = FeatureSupport(pixel, torch.ones(len(pixel), dtype=torch.bool), residuals)
        (obj,) = stage(frame / 30, table, depth, HERE).objects
        assert obj.motion_state is MotionState.STATIC


@pytest.mark.parametrize("label", [PERSON, DOG])
@pytest.mark.parametrize(("enabled", "motion_state"), [("true", MotionState.STATIC), ("false", MotionState.UNKNOWN)])
def test_new_detection_of_old_surface_is_static_at_once(label: int, enabled: str, motion_state: MotionState) -> None:
    """The network detects the object only after 1 s, when the free-space check has all its time spans."""
    thing = walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0), label=label)
    overrides = (f"objects.free_space.enabled={enabled}",)
    frames = simulate(
        *CHAIRS, thing, seconds=1.1, camera=handheld, hidden=lambda t: {3} if t < 1.05 else set(), overrides=overrides
    )
    assert ids(frames[:-1]) == {1, 2, 3}
    assert frames[-1][4].motion_state is motion_state


@pytest.mark.parametrize(("enabled", "motion_state"), [("true", MotionState.DYNAMIC), ("false", MotionState.UNKNOWN)])
def test_new_detection_in_free_space_is_dynamic_at_once(enabled: str, motion_state: MotionState) -> None:
    """A new object has no earlier distances for a vote, but its place was free space."""
    thing = walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0))
    overrides = (NO_UNLABELLED, f"objects.free_space.enabled={enabled}")
    frames = simulate(
        *CHAIRS, thing, seconds=0.6, camera=handheld, hidden=lambda t: {3} if t < 0.59 else set(), overrides=overrides
    )
    assert ids(frames[:-1]) == {1, 2, 3}
    assert frames[-1][4].motion_state is motion_state
    assert frames[-1][4].votes == 0
    assert not frames[-1].result.static_mask[frames[-1].owner == 3].any()


@CAMERAS
def test_walker_missed_by_the_network_is_masked(camera: Callable[[float], Tensor]) -> None:
    thing = walker((-0.8, 0.1, 2.3), (0.9, 0.0, 0.0))
    frames = simulate(*CHAIRS, thing, seconds=1.5, camera=camera, hidden=lambda _: {3})
    late = [frame for frame in frames if frame.stamp > 0.5]
    masked = torch.cat([~frame.result.static_mask[frame.owner == 3] for frame in late])
    assert float(masked.double().mean()) > 0.9
    assert states_of_class(late, UNLABELLED) == {MotionState.DYNAMIC}
    distance = [frame.result.static_mask[distance_to(frame.owner == 3) > 20] for frame in frames]
    assert torch.cat(distance).all()
    assert states_of_class(frames, CHAIR) == states_of_class(frames, TV) == {MotionState.STATIC}


@CAMERAS
def test_position_is_the_centroid_of_the_refined_mask(camera: Callable[[float], Tensor]) -> None:
    """The network draws the mask 3 pixels too small, without the feet: the centroid of the cloud is 10 cm too high."""
    stage = ObjectStage(load_config(None, (STRIDE, NO_UNLABELLED)).objects)
    thing, errors = walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)), []
    for index in range(16):
        t = index / 15
        depth, owner = render([thing], t, camera(t), 0.0014)
        named = detect(owner, [thing], set())
        without_feet = named.masks & (distance_to(~named.masks[0]) > 3)
        without_feet[:, 95:] = False
        (person,) = stage(t, replace(named, masks=without_feet), depth, camera(t)).objects
        points = (CAMERA.rays * depth[0][..., None])[owner == 0].double()
        true = camera(t)[:3, :3] @ points.mean(dim=0) + camera(t)[:3, 3]
        errors.append([float((each - true).norm()) for each in (person.centroid, person.cloud.double().mean(dim=0))])
        newest = person.history[-1]
        assert newest.stamp < t or torch.equal(newest.position, person.centroid)
    position, cloud = torch.tensor(errors).median(dim=0).values.tolist()
    assert cloud > 0.1 and position < 0.25 * cloud


@CAMERAS
def test_cloud_of_a_missed_object_moves_with_its_prediction(camera: Callable[[float], Tensor]) -> None:
    thing = walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0))
    frames = simulate(thing, seconds=0.8, camera=camera, hidden=lambda t: {0} if t > 0.6 else set())
    seen = [frame for frame in frames if not frame[1].missed][-1]
    for frame in frames:
        if frame[1].missed:
            motion = frame[1].cloud.double().mean(dim=0) - seen[1].cloud.double().mean(dim=0)
            torch.testing.assert_close(motion, frame[1].centroid - seen[1].centroid, rtol=0.0, atol=1e-5)
            assert float(motion[0]) == pytest.approx(0.9 * (frame.stamp - seen.stamp), abs=0.03)


@pytest.mark.parametrize(
    ("score", "sightings", "motion_state"),
    [(0.2, 1, MotionState.STATIC), (0.2, 2, MotionState.UNKNOWN), (0.4, 1, MotionState.UNKNOWN)],
)
def test_missed_object_with_low_score_is_static(score: float, sightings: int, motion_state: MotionState) -> None:
    things = (*CHAIRS, walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)))
    frames = simulate(*things, seconds=0.2, score=score, hidden=lambda t: {3} if 15 * t > sightings - 0.5 else set())
    for index, frame in enumerate(frames):
        assert frame[4].missed is (index >= sightings)
        assert frame[4].motion_state is (motion_state if frame[4].missed else MotionState.UNKNOWN)
        usable = frame.result.static_mask[frame.owner == 3]
        assert usable.all() if frame[4].motion_state is MotionState.STATIC else float(usable.double().mean()) < 0.05


def test_missed_object_with_low_score_that_moved_is_dynamic() -> None:
    """Eleven detections with scores of 0.02 add up to 0.22, less than the 0.3 that a static object needs."""
    thing = walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0))
    hidden = {"score": 0.02, "hidden": lambda t: {3} if t > 0.69 else set()}
    frame = simulate(*CHAIRS, thing, seconds=0.8, overrides=(NO_UNLABELLED,), **hidden)[-1]  # type: ignore[arg-type]
    assert frame[4].missed
    assert frame[4].motion_state is MotionState.DYNAMIC


def test_missed_object_that_stopped_is_static_at_once() -> None:
    """Without the rule the dynamic state would last to the end: 0.9 s until the last evidence, and 1 s held."""
    thing = walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.5)
    frames = simulate(*CHAIRS, thing, seconds=1.7, hidden=lambda t: {3} if t > 1.55 else set())
    for frame in frames:
        if frame.stamp > 1.45:
            assert frame[4].missed is (frame.stamp > 1.55)
            assert frame[4].motion_state is (MotionState.STATIC if frame[4].missed else MotionState.DYNAMIC)


def test_static_mask_excludes_moving_and_unknown_objects_only() -> None:
    """The background is metres behind the objects: only the dilation of 1 pixel masks a part of it."""
    things = (*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)), swaying_person((1.0, 0.0, 2.0)))
    frame = simulate(*things, seconds=0.9)[-1]
    assert [frame[number].motion_state for number in (4, 5)] == [MotionState.DYNAMIC, MotionState.DEFORMING]
    late = simulate(*things, seconds=0.1)[-1]
    assert [late[number].motion_state for number in (4, 5)] == [MotionState.UNKNOWN, MotionState.UNKNOWN]
    for shown in (frame, late):
        distance = distance_to(shown.owner >= 3)
        assert not shown.result.static_mask[distance == 0].any()
        assert shown.result.static_mask[distance >= 2].all()
        # Chairs stay in the static mask.
        assert int(((shown.owner >= 0) & (shown.owner < 3) & (distance >= 2)).sum()) > 500


@pytest.mark.parametrize("mask_growth", [-3, 4])
def test_refined_mask_follows_the_depth(mask_growth: int) -> None:
    """The mask of the network misses the rim, or includes a part of the wall, 250 pixels or more."""
    frames = simulate(*CHAIRS[:2], walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)), seconds=0.6, mask_growth=mask_growth)
    for frame in frames:
        assert frame[3].motion_state is not MotionState.STATIC
        assert int((frame[3].mask ^ (frame.owner == 2)).sum()) < 100
        distance = distance_to(frame.owner == 2)
        # A side seen at a grazing angle is not in the cloud.
        assert not frame.result.static_mask[distance_to(frame.owner != 2) > 1].any()
        assert frame.result.static_mask[distance >= 2].all()


def test_depth_margin_limits_the_refined_mask() -> None:
    frame = simulate(
        *CHAIRS[:2],
        walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)),
        seconds=0.1,
        mask_growth=-6,
        overrides=(
            "objects.static_mask.depth_margin=2",
            "objects.static_mask.surface_margin=0",
            "objects.static_mask.dilation=0",
        ),
    )[-1]
    own, distance = frame.owner == 2, 6 - distance_to(frame.owner != 2)  # from the network's mask
    assert frame.result.static_mask[own & (distance >= 3)].all()
    assert float(frame.result.static_mask[own & (distance <= 2)].double().mean()) < 0.02
    assert int((own & (distance >= 3)).sum()) > 100


def test_pixels_without_depth_are_masked_within_the_margin() -> None:
    """A structured-light camera has no depth beside near objects."""
    thing = walker((-0.1, 0.1, 2.3), (0.0, 0.0, 0.0))
    depth, owner = render([thing], 0.0, HERE, 0.0)
    distance = distance_to(owner == 0)
    depth[0, (distance > 0) & (distance < 20)] = 0.0
    stage = ObjectStage(
        load_config(None, (STRIDE, "objects.static_mask.depth_margin=5", "objects.static_mask.dilation=0")).objects
    )
    static = stage(0.0, detect(owner, [thing], set()), depth, HERE).static_mask
    assert not static[distance <= 4].any()
    assert static[distance >= 6].all()


def test_zero_margin_and_dilation_mask_the_object_only() -> None:
    overrides = ("objects.static_mask.depth_margin=0", "objects.static_mask.dilation=0")
    frame = simulate(*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0)), seconds=0.2, overrides=overrides)[-1]
    assert frame.result.static_mask[frame.owner != 3].all()
    assert not frame.result.static_mask[
        distance_to(frame.owner != 3) > 1
    ].any()  # a side seen at a grazing angle is not in the cloud


def test_keep_deforming_features_keeps_deforming_objects_in_the_mask() -> None:
    things = (*CHAIRS, swaying_person((0.0, 0.1, 2.4)))
    included, masked = (
        simulate(*things, seconds=0.8, overrides=(f"objects.chamfer.keep_deforming_features={include}",))[-1]
        for include in ("true", "false")
    )
    assert included[4].motion_state is masked[4].motion_state is MotionState.DEFORMING
    assert included.result.static_mask.all()
    assert not masked.result.static_mask[masked.owner == 3].any()


def test_static_person_is_in_static_mask_but_not_in_mask_without_people() -> None:
    things = (CHAIRS[0], walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0)))
    result = (frame := simulate(*things, seconds=1.2)[-1]).result
    assert frame[2].motion_state is MotionState.STATIC
    assert result.static_mask.all()
    distance = distance_to(frame.owner == 1)
    assert not result.map_mask[distance <= 3].any()
    assert result.map_mask[distance >= 5].all()


def test_missed_walker_continues_as_unlabelled_instance() -> None:
    things = (*CHAIRS, walker((-0.8, 0.1, 2.3), (0.9, 0.0, 0.0)))
    frames = simulate(*things, seconds=1.6, hidden=lambda t: {3} if t > 0.65 else set())
    for frame in frames:
        if frame.stamp > 0.65:  # later than the maximum time of prediction, half a second
            assert frame[4].motion_state is MotionState.DYNAMIC
            assert not frame[4].missed
            assert frame[4].label == PERSON  # the class of most detections
            assert float((~frame.result.static_mask)[frame.owner == 3].double().mean()) > 0.9
    assert ids(frames) == {1, 2, 3, 4}


def test_missed_walker_is_masked_where_predicted_and_then_removed() -> None:
    things = (*CHAIRS, walker((-0.6, 0.1, 2.3), (0.9, 0.0, 0.0)))
    frames = simulate(*things, seconds=1.4, hidden=lambda t: {3} if t > 0.65 else set(), overrides=(NO_UNLABELLED,))
    for frame in frames[:-1]:
        if 0.65 < frame.stamp < 1.1:
            assert frame[4].missed
            assert frame[4].motion_state is MotionState.DYNAMIC
            assert math.isnan(frame[4].chamfer)
            true_x = -0.6 + 0.9 * frame.stamp
            assert float(frame[4].centroid[0]) == pytest.approx(true_x, abs=0.1)
            masked = (~frame.result.static_mask)[frame.owner == 3]
            assert float(masked.double().mean()) > 0.98
    assert 4 not in {obj.id for obj in frames[-1].result.objects}
    assert frames[-1].result.static_mask.all()


@pytest.mark.parametrize("mask_growth", [0.0, 4.0, 8.0])
def test_missed_walker_is_visible_although_the_mask_of_another_one_covers_it(mask_growth: float) -> None:
    """With large masks, that of the right walker covers the left one, whom the network misses at the end."""
    left, right = walker((-0.57, 0.1, 3.0), (0.6, 0.0, 0.0)), walker((-0.15, 0.1, 2.3), (0.46, 0.0, 0.0))
    last = simulate(
        *CHAIRS, left, right, seconds=0.7, hidden=lambda t: {3} if t > 0.65 else set(), mask_growth=mask_growth
    )[-1]
    assert last[4].missed and not last[5].missed
    for number in (4, 5):
        visible, true = last[number].mask, last.owner == number - 1
        assert int((visible & true).sum()) > 0.95 * int((visible | true).sum())
    assert float((~last.result.static_mask)[last.owner == 3].double().mean()) > 0.95


def test_without_votes_free_space_alone_shows_motion_and_without_both_there_is_none() -> None:
    things, no_voting = (*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0))), "objects.voting.enabled=false"
    with_free_space = simulate(*things, seconds=0.5, overrides=(no_voting,))
    without = simulate(*things, seconds=0.5, overrides=(no_voting, "objects.free_space.enabled=false"))
    assert {frame[4].votes for frame in (*with_free_space, *without)} == {0}
    assert MotionState.DYNAMIC in motion_states(with_free_space, 4)
    assert MotionState.DYNAMIC not in motion_states(without, 4)


def test_disabled_chamfer_gives_no_deformation() -> None:
    no_chamfer = simulate(
        *CHAIRS, swaying_person((0.0, 0.1, 2.4)), seconds=0.8, overrides=("objects.chamfer.enabled=false",)
    )
    assert MotionState.DEFORMING not in motion_states(no_chamfer, 4)
    assert all(math.isnan(frame[4].chamfer) for frame in no_chamfer)


@pytest.mark.parametrize(
    "thing", [walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.1), stop=0.5), swaying_person((0.0, 0.1, 2.4))]
)
def test_world_correction_keeps_motion_states(thing: Thing) -> None:
    T_new_old = se3_exp(torch.tensor([0.7, -0.2, 1.5, 0.2, -0.8, 0.4], dtype=torch.float64))
    overrides = ("objects.static_mask.hold_dynamic_time=0.2",)
    arguments = {"seconds": 1.2, "camera": handheld, "overrides": overrides}
    uncorrected = simulate(*CHAIRS, thing, **arguments)  # type: ignore[arg-type]
    corrected = simulate(*CHAIRS, thing, correction=(0.5, T_new_old), **arguments)  # type: ignore[arg-type]
    assert ids(uncorrected) == ids(corrected) == {1, 2, 3, 4}
    assert len(motion_states(uncorrected, 4)) > 1
    for old, new in zip(uncorrected, corrected, strict=True):
        for number in (1, 2, 3, 4):
            assert old[number].motion_state is new[number].motion_state
            assert old[number].votes == new[number].votes
            assert old[number].chamfer == pytest.approx(new[number].chamfer, abs=1e-5, nan_ok=True)
        T = HERE if new.stamp < 0.5 else T_new_old
        expected = T[:3, :3] @ old[4].centroid + T[:3, 3]
        torch.testing.assert_close(new[4].centroid, expected, rtol=0.0, atol=1e-5)


# The paper's literal rules on given centroids: four objects on the corners of a rectangle of 0.6 m by 0.8 m.
CORNERS = torch.tensor([[0.0, 0.0, 2.0], [0.6, 0.0, 2.0], [0.0, 0.8, 2.0], [0.6, 0.8, 2.0]])


class PaperStage:
    """Object stage with configs/paper.yaml; every object is a small ball of points around its centroid."""

    def __init__(self) -> None:
        config = load_config(PAPER).objects
        self._classify = MotionClassifier(config, CAMERA)
        self._free_space_check = FreeSpaceCheck(config.free_space, CAMERA)
        self._frame = -1
        self.vote_pairs: list[tuple[int, int]] = []

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
        result = self._classify(instances, clouds, view, self._free_space_check(view), NO_FEATURES)
        self._free_space_check.add_view(view, view.T_dw)
        self.vote_pairs = result.vote_pairs
        return {obj.id: obj for obj in result.objects}


def test_paper_rules_equal_algorithm_1_by_hand() -> None:
    """A moves 0.1 m towards C. Distances of A: to B 0.6 -> 0.608, to C 0.8 -> 0.7, to D 1.0 -> 0.922.

    With T_d = 0.05 m, A and C vote for each other, and so do A and D. With T_v = 2 only A, with two votes, is dynamic.
    """
    stage = PaperStage()
    assert {obj.votes for obj in stage(CORNERS).values()} == {0}
    moved = CORNERS.clone()
    moved[0, 1] = 0.1
    objects = stage(moved)
    assert {number: objects[number].votes for number in objects} == {1: 2, 2: 0, 3: 1, 4: 1}
    assert stage.vote_pairs == [(1, 3), (1, 4), (3, 1), (4, 1)]  # voter, candidate
    for number, centroid in enumerate(moved, start=1):
        torch.testing.assert_close(objects[number].cloud.mean(dim=0), centroid, rtol=0.0, atol=1e-5)
    assert [objects[number].motion_state is MotionState.DYNAMIC for number in (1, 2, 3, 4)] == [
        True,
        False,
        False,
        False,
    ]
    # Consecutive frames only, and no memory: in the next frame all objects stand still and are static.
    objects = stage(moved)
    assert {objects[number].votes for number in objects} == {0} and stage.vote_pairs == []
    assert {objects[number].motion_state for number in objects} == {MotionState.STATIC}


def test_paper_rules_let_two_moving_objects_outvote_the_others() -> None:
    """A and D move 0.1 m up and down: B and C get votes from both and become dynamic as well.

    Distances: AB 0.6 -> 0.608, AC 0.8 -> 0.9, AD 1.0 -> 1.166, BD 0.8 -> 0.9, CD 0.6 -> 0.608, BC as it was. So A and
    D have two votes, B and C one. With A also 0.1 m to the left: AB 0.7071, AC 0.906: two votes for B and C.
    """
    stage = PaperStage()
    stage(CORNERS)
    moved = CORNERS.clone()
    moved[0, 1] -= 0.1
    moved[3, 1] += 0.1
    objects = stage(moved)
    assert [objects[number].votes for number in (1, 2, 3, 4)] == [2, 1, 1, 2]
    stage = PaperStage()
    stage(CORNERS)
    moved[0, 0] -= 0.1
    moved[3, 0] += 0.1
    objects = stage(moved)
    assert [objects[number].votes for number in (1, 2, 3, 4)] == [3, 2, 2, 3]
    assert {objects[number].motion_state for number in objects} == {MotionState.DYNAMIC}


def test_paper_rules_need_no_pose() -> None:
    """The given pose is wrong, but no distance between two objects changes."""
    wrong = se3_exp(torch.tensor([0.06, 0.02, -0.05, 0.02, 0.03, -0.05], dtype=torch.float64))
    stage = PaperStage()
    stage(CORNERS)
    objects = stage(CORNERS, wrong)
    assert [objects[number].votes for number in (1, 2, 3, 4)] == [0, 0, 0, 0]
    assert MotionState.DYNAMIC not in {objects[number].motion_state for number in objects}


def test_paper_rules_give_no_vote_to_objects_missing_in_the_previous_frame() -> None:
    """Algorithm 1 compares the keys of both frames. A moved while the network missed it."""
    stage = PaperStage()
    stage(CORNERS)
    stage(CORNERS[1:])
    moved = CORNERS.clone()
    moved[0, 1] = 0.1
    objects = stage(moved)
    assert [objects[number].votes for number in (1, 2, 3, 4)] == [0, 0, 0, 0]


def test_nothing_is_dynamic_without_free_space_evidence() -> None:
    """A box moves by 6 cm per frame, but the images have no depth for the free-space check."""
    stage = ObjectStage(load_config(None, (STRIDE,)).objects)
    nothing = torch.zeros(1, CAMERA.height, CAMERA.width)
    for frame in range(12):
        things = [static_box((0.06 * frame - 0.3, 0.2, 3.0)), static_box((0.8, 0.2, 3.0))]
        depth, owner = render(things, frame / 30, HERE, 0.0)
        result = stage(frame / 30, detect(owner, things, set()), nothing, HERE, cloud_depth=depth)
        assert [obj.motion_state for obj in result.objects] == [MotionState.STATIC, MotionState.STATIC]


@pytest.mark.parametrize(("label", "motion_state"), [(PERSON, MotionState.DYNAMIC), (CHAIR, MotionState.STATIC)])
def test_furniture_of_which_little_is_known_to_have_appeared_is_static(label: int, motion_state: MotionState) -> None:
    """The view before did not observe most of the place of the object; what it observed was free."""
    stage = ObjectStage(load_config(None, (STRIDE, NO_UNLABELLED)).objects)
    wall = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    wall[..., 60:] = 0.0
    nobody = Instances.empty(CAMERA.height, CAMERA.width)
    for frame in range(2):
        stage(0.3 * frame, nobody, wall, HERE)
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[:, 30:90, 40:140] = True
    instance = Instances(mask, torch.tensor([label]), torch.tensor([0.9]), torch.zeros(1, 4))
    (obj,) = stage(0.6, instance, torch.full_like(wall, WALL).masked_fill(mask, 2.0), HERE).objects
    assert obj.motion_state is motion_state


def test_empty_scene_gives_empty_result() -> None:
    frames = simulate(seconds=0.2)
    assert all(frame.result.objects == [] for frame in frames)
    assert all(frame.result.static_mask.all() for frame in frames)
    assert frames[0].result.static_mask.shape == (CAMERA.height, CAMERA.width)


def test_objects_without_depth_are_static_things_and_unknown_people() -> None:
    stage = ObjectStage(load_config(None, (STRIDE,)).objects)
    things = [CHAIRS[0], walker((0.0, 0.1, 2.5), (0.0, 0.0, 0.0))]
    for frame in range(12):
        _, owner = render(things, 0.0, HERE, 0.0)
        nothing = torch.zeros(1, CAMERA.height, CAMERA.width)
        result = stage(frame / 30, detect(owner, things, set()), nothing, HERE)
        assert [obj.motion_state for obj in result.objects] == [MotionState.STATIC, MotionState.UNKNOWN]
        assert all(torch.isnan(obj.centroid).all() and math.isnan(obj.chamfer) for obj in result.objects)
        assert not result.static_mask[owner == 1].any()


def test_person_who_walks_after_a_gap_in_time_is_never_static() -> None:
    """The person stands for 1.4 s; 2 s later, with nothing observed between, the person walks."""
    stage = ObjectStage(load_config(None, (STRIDE, NO_UNLABELLED)).objects, CAMERA)
    stamps = [*(0.2 * i for i in range(8)), *(3.4 + i / 30 for i in range(15))]
    for stamp in stamps:
        things = [walker((-0.6 + 0.9 * max(stamp - 3.0, 0.0), 0.1, 2.5), (0.0, 0.0, 0.0))]
        depth, owner = render(things, stamp, HERE, 0.0)
        (person,) = stage(stamp, detect(owner, things, set()), depth, HERE).objects
        assert person.id == 1
        assert (person.motion_state is MotionState.STATIC) is (1.0 <= stamp < 3.4)


def test_one_moving_object_among_a_hundred_is_dynamic() -> None:
    """A grid of small boxes in a plane at 2 m; one in the middle moves towards the camera."""
    places = [(0.22 * c - 1.0, 0.17 * r - 0.77) for r in range(10) for c in range(10)]
    things = [static_box((x, y, 2.0), (0.17, 0.13, 0.02), TV) for x, y in places]
    x, y = places[44]
    things[44] = Thing(TV, lambda t: [((x, y, 2.0 - 0.9 * t), (0.17, 0.13, 0.02))])
    overrides = ("objects.free_space.min_points=4",)  # for the smaller images: a box has 6 of every 4th pixel
    frames = simulate(*things, seconds=0.4, rate=10.0, noise=0.0, overrides=overrides)
    assert ids(frames) == set(range(1, 101))
    moving = {obj.id for obj in frames[-1].result.objects if obj.motion_state is not MotionState.STATIC}
    assert moving == {45}


def test_equal_stamps_are_accepted() -> None:
    stage = ObjectStage(ObjectsConfig.model_validate({"clouds": {"stride": 1}}))
    for _ in range(3):
        depth, owner = render(list(CHAIRS), 0.0, handheld(0.3), 0.0)
        result = stage(5.0, detect(owner, list(CHAIRS), set()), depth, handheld(0.3))
        assert [obj.id for obj in result.objects] == [1, 2, 3]
        assert {obj.motion_state for obj in result.objects} == {MotionState.STATIC}


def assert_identical(a: FrameObjects, b: FrameObjects) -> None:
    assert list(differences(a, b, "objects", {})) == []


def test_repeated_runs_are_identical() -> None:
    things = (*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.1)))
    first_run, second_run = (simulate(*things, seconds=0.5, camera=handheld) for _ in range(2))
    for a, b in zip(first_run, second_run, strict=True):
        assert_identical(a.result, b.result)


def test_state_dict_continues_with_identical_results() -> None:
    """A walker who stops, a swaying person, and a missed object: all of the state matters after the copy."""
    things = [*CHAIRS, walker((-0.5, 0.1, 2.3), (0.9, 0.0, 0.0), stop=0.5), swaying_person((1.0, 0.0, 2.0))]
    config = load_config(None, (STRIDE,)).objects
    original, continued = ObjectStage(config), ObjectStage(config)
    states = set()
    for index in range(24):
        t = index / 15
        if index == 10:
            continued.load_state_dict(copy.deepcopy(original.state_dict()))
        depth, owner = render(things, t, handheld(t), 0.0014)
        instances = detect(owner, things, {1} if index in (9, 10, 11) else set())
        result = original(t, instances, depth, handheld(t))
        if index >= 10:
            assert_identical(result, continued(t, instances, depth, handheld(t)))
            states |= {obj.motion_state for obj in result.objects}
    assert states == {MotionState.STATIC, MotionState.DYNAMIC, MotionState.DEFORMING}
