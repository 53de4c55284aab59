"""A room simulated for the object stage: people and furniture before a depth camera in a hand, and a network that errs.

The world is the usual camera frame at rest: x right, y down, z forward, metres. Images are a quarter of the usual size,
which is the resolution of a network's masks, so that an error of one of its pixels is one pixel here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path as FilePath

import cv2
import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_smoother import DepthSmoother
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.feature_support import FeatureSupport
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.objects.free_space_check import FreeSpaceCheck
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.objects.motion_classifier import MotionClassifier
from v3d_torch.objects.unlabelled import unlabelled_instances
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
SCALE = ("objects.clouds.stride=1", "objects.static_mask.depth_margin=2")  # what the smaller images ask for
WALL, FLOOR = 5.0, 1.2
PERSON, DOG, CHAIR, COUCH, TABLE, TV = 0, 16, 56, 57, 60, 62
LEAST_PIXELS = 60  # the network finds nothing smaller: 31 x 31 pixels of an image of the usual size

Vector = tuple[float, float, float]
Path = Callable[[Tensor], Tensor]  # times, seconds, (B,), to places, metres, (B, 3)


# ---------------------------------------------------------------- what there is


@dataclass(frozen=True)
class Part:
    """A box along the axes of the world, or the upright elliptic cylinder inscribed in it."""

    half: Vector
    place: Path
    round: bool = False


@dataclass(frozen=True)
class Thing:
    """An object made of parts; the network has no class for one without a label."""

    label: int | None
    parts: tuple[Part, ...]


def stand(x: float, z: float, y: float = FLOOR) -> Path:
    return lambda t: torch.tensor([x, y, z]).expand(len(t), 3)


def walk(x: float, z: float, vx: float, vz: float, start: float = 0.0, stop: float = math.inf) -> Path:
    """On the floor from (x, z) at constant velocity between two times."""

    def place(t: Tensor) -> Tensor:
        passed = t.clamp(start, stop) - start
        return torch.stack([x + vx * passed, torch.full_like(t, FLOOR), z + vz * passed], dim=-1)

    return place


def shift(path: Path, dx: Callable[[Tensor], Tensor] | float, dy: float, dz: float = 0.0) -> Path:
    """A path beside a path; ``dx`` may change with time."""

    def place(t: Tensor) -> Tensor:
        aside = dx(t) if callable(dx) else torch.full_like(t, dx)
        return path(t) + torch.stack([aside, torch.full_like(t, dy), torch.full_like(t, dz)], dim=-1)

    return place


def furniture(label: int | None, path: Path, size: Vector) -> Thing:
    """A box whose underside is at the path."""
    return Thing(label, (Part(tuple(side / 2 for side in size), shift(path, 0.0, -size[1] / 2)),))  # type: ignore[arg-type]


def chair(path: Path, label: int = CHAIR) -> Thing:
    """Seat and back, 0.85 m high."""
    seat = Part((0.23, 0.23, 0.23), shift(path, 0.0, -0.23))
    back = Part((0.23, 0.2, 0.04), shift(path, 0.0, -0.65, 0.19))
    return Thing(label, (seat, back))


def person(path: Path, stride: float = 0.0, phase: float = 0.0, wave: float = 0.0, seated: bool = False) -> Thing:
    """Somebody 1.73 m tall: trunk, head, legs, and arms if they wave.

    Args:
        path: of the point between the feet.
        stride: by how much the legs swing at 1 Hz, metres.
        phase: of the swing, radians.
        wave: by how much the arms go out and in at 1 Hz, metres.
        seated: on a stool, thighs towards the camera.
    """
    low = 0.4 if seated else 0.0
    parts = [
        Part((0.2, 0.31, 0.12), shift(path, 0.0, low - 1.15), round=True),
        Part((0.09, 0.14, 0.1), shift(path, 0.0, low - 1.59), round=True),
    ]
    for side in (-1, 1):
        swing = partial(_swing, side * 0.1, side * stride, phase)
        parts.append(Part((0.08, 0.43, 0.09), shift(path, swing, -0.43), round=True))
        if wave:
            reach = partial(_swing, side * (0.25 + wave / 2), side * wave / 2, phase)
            parts.append(Part((0.06, 0.28, 0.06), shift(path, reach, low - 1.15), round=True))
    if seated:
        parts[2:4] = [Part((0.18, 0.25, 0.3), shift(path, 0.0, -0.25, -0.2))]
    return Thing(PERSON, tuple(parts))


def _swing(rest: float, amplitude: float, phase: float, t: Tensor) -> Tensor:
    return rest + amplitude * torch.sin(2 * math.pi * t + phase)


# ---------------------------------------------------------------- how it is seen


def still_camera(t: Tensor) -> Tensor:
    return torch.eye(4, dtype=torch.float64).expand(len(t), 4, 4)


def handheld(t: Tensor) -> Tensor:
    """Somebody stands and holds the camera: it shakes by a centimetre and a degree."""
    waves = [torch.sin(2 * math.pi * rate * t + start) for rate, start in ((1.1, 0.0), (0.7, 1.0), (1.7, 2.0))]
    shake = torch.stack([*waves, *waves], dim=-1)
    return se3_exp(shake * torch.tensor([0.012, 0.012, 0.008, 0.012, 0.018, 0.01], dtype=torch.float64))


def roaming(t: Tensor) -> Tensor:
    """Somebody walks with the camera: 0.35 m/s aside, 0.15 m/s forward, turning by 0.2 rad/s, and shakes it."""
    rates = torch.tensor([0.35, 0.0, 0.15, 0.0, -0.2, 0.02], dtype=torch.float64)
    start = torch.tensor([-0.3, 0.0, -0.1, 0.0, 0.2, 0.0], dtype=torch.float64)
    return se3_exp(start + t[:, None] * rates) @ handheld(t)


def render(things: list[Thing], t: Tensor, T_wc: Tensor) -> tuple[Tensor, Tensor]:
    """True depth, metres, and the thing at each pixel, -1 = the room, both of shape (B, H, W)."""
    origin = T_wc[:, None, None, :3, 3].float()
    direction = torch.einsum("bij,hwj->bhwi", T_wc[:, :3, :3].float(), CAMERA.rays)  # of unit depth
    floor = (FLOOR - origin[..., 1]) / direction[..., 1]
    depth = torch.where(floor > 0, floor, math.inf).minimum((WALL - origin[..., 2]) / direction[..., 2])
    owner = torch.full(depth.shape, -1)
    for i, thing in enumerate(things):
        for part in thing.parts:
            place = part.place(t)
            rows, columns = _window(part, place, T_wc)
            hit = _enter(part, place.float()[:, None, None] - origin, direction[:, rows, columns])
            nearer = (hit > 0.1) & (hit < depth[:, rows, columns])
            depth[:, rows, columns] = torch.where(nearer, hit, depth[:, rows, columns])
            owner[:, rows, columns][nearer] = i
    return depth, owner


def _window(part: Part, place: Tensor, T_wc: Tensor) -> tuple[slice, slice]:
    """Rows and columns of the image within which a part stays: the rest need not be looked at."""
    corners = place[:, None] + torch.cartesian_prod(*(torch.tensor([-half, half]) for half in part.half))
    in_camera = (corners - T_wc[:, None, :3, 3]) @ T_wc[:, :3, :3]
    if bool((in_camera[..., 2] < 0.1).any()):
        return slice(None), slice(None)
    low, high = CAMERA.project(in_camera).flatten(0, 1).aminmax(dim=0)
    (left, top), (right, bottom) = low.clamp(min=0).floor().int().tolist(), high.clamp(min=0).ceil().int().tolist()
    return slice(top, bottom + 1), slice(left, right + 1)


def _enter(part: Part, centre: Tensor, direction: Tensor) -> Tensor:
    """Depth at which rays enter a part, inf where they miss it, (B, H, W)."""
    half = torch.tensor(part.half)
    sides = torch.stack([(centre - half) / direction, (centre + half) / direction])
    enter, leave = sides.amin(dim=0), sides.amax(dim=0)
    if part.round:  # of x and z together: where |direction * s - centre| = 1 in units of the radii
        d, c = (direction / half)[..., ::2], (centre / half)[..., ::2]
        square, middle = (d * d).sum(-1), (d * c).sum(-1)
        root = (middle.square() - square * ((c * c).sum(-1) - 1)).sqrt()  # nan where the ray misses
        enter = torch.stack([(middle - root) / square, enter[..., 1]], dim=-1)
        leave = torch.stack([(middle + root) / square, leave[..., 1]], dim=-1)
    first, last = enter.amax(dim=-1), leave.amin(dim=-1)
    return torch.where(first <= last, first, math.inf)


def measured(depth: Tensor, generator: torch.Generator) -> Tensor:
    """Depth as a structured-light camera gives it (Khoshelham and Elberink, Sensors 2012), shape as the input.

    The error is 0.0014 z^2, disparity comes in eighths of a pixel, half of the pixels beside a depth edge are lost, and
    some anywhere.
    """
    noisy = depth + 0.0014 * depth.square() * torch.randn(depth.shape, generator=generator)
    step = 0.00285  # 1/m: an eighth of a pixel at 580 pixels and 0.075 m
    quantised = 1 / (step * (1 / (step * noisy)).round())
    edge = max_pool2d(depth[:, None], 3, 1, 1)[:, 0] > 1.06 * -max_pool2d(-depth[:, None], 3, 1, 1)[:, 0]
    lost = torch.rand(depth.shape, generator=generator) < 0.01 + 0.49 * edge
    return torch.where(lost, 0.0, quantised)


def misplaced(T_wc: Tensor, t: Tensor, generator: torch.Generator) -> Tensor:
    """Poses as odometry gives them: off by 3 mm and 0.2 degrees in each frame, and drifting by 1 cm/s."""
    sigma = torch.tensor([0.003] * 3 + [math.radians(0.2)] * 3, dtype=torch.float64) / math.sqrt(3)
    error = sigma * torch.randn(len(t), 6, generator=generator, dtype=torch.float64)
    error[:, 0] += 0.01 * t
    return T_wc @ se3_exp(error)


# ---------------------------------------------------------------- what the network makes of it


@dataclass(frozen=True)
class Network:
    """How the segmentation errs.

    Measured with the real network on still things before a still camera: from frame to frame a contour scatters by 0.1
    to 0.3 of these pixels, and a tenth of the masks of a chair lack a third of it.

    Attributes:
        contour: standard deviation of a contour, pixels; neighbouring parts of it err together.
        bite: probability that a mask lacks a third of its object, at one of the four sides.
        missed: whether a thing is missed at a time.
        flicker: other class of a thing, and how probable it is.
        shuffled: instances come in an order that changes from frame to frame; else in that of the things.
    """

    contour: float = 0.3
    bite: float = 0.0
    missed: Callable[[int, float], bool] = lambda thing, t: False
    flicker: dict[int, tuple[int, float]] = field(default_factory=dict)
    shuffled: bool = False

    def __call__(
        self, owner: Tensor, things: list[Thing], t: float, generator: torch.Generator
    ) -> tuple[Instances, list[int]]:
        """Instances of an image, and the thing that each shows."""
        pixels = torch.bincount(owner.flatten() + 1, minlength=len(things) + 1)[1:]
        shown = [
            i
            for i, thing in enumerate(things)
            if thing.label is not None and int(pixels[i]) >= LEAST_PIXELS and not self.missed(i, t)
        ]
        if self.shuffled:
            shown = [shown[i] for i in torch.randperm(len(shown), generator=generator).tolist()]
        if not shown:
            return Instances.empty(*owner.shape), []
        masks = torch.stack([self._draw(owner == i, generator) for i in shown])
        labels = torch.tensor([self._name(i, things[i], generator) for i in shown])
        boxes = torch.stack([_bounds(mask) for mask in masks])
        return Instances(masks, labels, torch.linspace(0.9, 0.5, len(shown)), boxes), shown

    def _draw(self, mask: Tensor, generator: torch.Generator) -> Tensor:
        bite, side = torch.rand(2, generator=generator).tolist()
        if bite < self.bite:
            mask = mask & ~_third(mask, int(4 * side))
        inside, outside = (
            cv2.distanceTransform(part.to(torch.uint8).numpy(), cv2.DIST_L2, 3) for part in (mask, ~mask)
        )
        coarse = torch.randn(1, 1, mask.shape[0] // 8, mask.shape[1] // 8, generator=generator)
        error = self.contour * interpolate(coarse, mask.shape, mode="bicubic")[0, 0]
        # Distances are to the nearest pixel of the other kind: the contour lies half a pixel before it.
        return torch.from_numpy(inside - outside) - 0.5 * (2 * mask.float() - 1) > error

    def _name(self, i: int, thing: Thing, generator: torch.Generator) -> int:
        other, probability = self.flicker.get(i, (thing.label, 0.0))
        label = other if float(torch.rand((), generator=generator)) < probability else thing.label
        assert label is not None
        return label


def _bounds(mask: Tensor) -> Tensor:
    """Left, top, right, bottom."""
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    if len(rows) == 0:
        return torch.zeros(4)
    return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()[:, 0]


def _third(mask: Tensor, side: int) -> Tensor:
    """The third of the image of an object at one of its sides: left, top, right, bottom."""
    left, top, right, bottom = _bounds(mask).tolist()
    v, u = torch.meshgrid(torch.arange(mask.shape[0]), torch.arange(mask.shape[1]), indexing="ij")
    third = [u < left + (right - left) / 3, v < top + (bottom - top) / 3]
    return [*third, u >= right - (right - left) / 3, v >= bottom - (bottom - top) / 3][side]


# ---------------------------------------------------------------- what the object stage makes of that


@dataclass(frozen=True)
class Frame:
    """The truth of one frame and what the object stage says of it.

    Attributes:
        stamp: seconds.
        owner: the thing at each pixel, -1 = the room, (H, W).
        shown: things that the network gave.
        scene: answer of the object stage.
    """

    stamp: float
    owner: Tensor
    shown: list[int]
    scene: FrameObjects

    def of(self, thing: int) -> TrackedObject | None:
        """The object, found by the network in this frame, that lies best on what is in sight of a thing."""
        objects = [judged for judged in self.scene.objects if not judged.missed]
        best = max(objects, key=lambda judged: self.overlap(judged, thing), default=None)
        return best if best is not None and self.overlap(best, thing) >= 0.3 else None

    def pixels(self, thing: int) -> int:
        """How much of a thing is in sight."""
        return int((self.owner == thing).sum())

    def overlap(self, judged: TrackedObject, thing: int) -> float:
        """Intersection over union of an object's mask with what is in sight of a thing."""
        truth = self.owner == thing
        return float((judged.mask & truth).sum() / (judged.mask | truth).sum().clamp(min=1))


@dataclass(frozen=True)
class Run:
    """Frames of a scene. Of a thing those count in which the network gave it with a quarter of it in sight at least."""

    frames: list[Frame]

    def clear(self, thing: int, since: float = 0.0, until: float = math.inf) -> list[Frame]:
        """The frames that count, between two times in seconds."""
        quarter = max(frame.pixels(thing) for frame in self.frames) / 4
        within = [frame for frame in self.frames if since <= frame.stamp <= until]
        frames = [frame for frame in within if thing in frame.shown and frame.pixels(thing) >= quarter]
        assert len(frames) >= 3, f"thing {thing} is hardly in sight between {since} and {until} s"
        return frames

    def share(self, thing: int, *verdicts: MotionState, since: float = 0.0, until: float = math.inf) -> float:
        """Share of the frames that judge a thing so; one without an object for it does not."""
        judged = [frame.of(thing) for frame in self.clear(thing, since, until)]
        return sum(one is not None and one.motion_state in verdicts for one in judged) / len(judged)

    def ids(self, thing: int, since: float = 0.0, until: float = math.inf) -> set[int]:
        """Ids under which a thing went."""
        return {one.id for frame in self.clear(thing, since, until) if (one := frame.of(thing)) is not None}

    def usable(self, thing: int, since: float = 0.0) -> float:
        """Share of the pixels of a thing that tracking may use."""
        pixels = torch.cat([frame.scene.static_mask[frame.owner == thing] for frame in self.clear(thing, since)])
        return float(pixels.double().mean())


NO_WITNESSES = FeatureSupport(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0, dtype=torch.bool))
"""Scenes are depth alone."""


class ObjectStage:
    """The object stage as `V3DSLAM` calls it: the one place that knows its signature."""

    def __init__(self, config: Config) -> None:
        self._smooth = DepthSmoother(config.depth.kernel_size, config.depth.sigma, config.depth.edge_ratio)
        self._watch = FreeSpaceCheck(config.objects.free_space, CAMERA)
        self._min_area = config.objects.free_space.min_unlabelled_area
        self._lift = InstanceBackProjector(config.objects.clouds, CAMERA)
        self._judge = MotionClassifier(config.objects, CAMERA)

    def __call__(self, stamp: float, instances: Instances, depth: Tensor, T_wc: Tensor) -> FrameObjects:
        depth = self._smooth(depth[None])[0]
        view = self._watch.make_view(stamp, depth, invert(T_wc))
        arrivals = self._watch(view)
        instances = instances.concatenate(unlabelled_instances(arrivals, instances, depth, CAMERA, self._min_area))
        scene = self._judge(instances, self._lift(depth, instances), view, arrivals, NO_WITNESSES)
        self._watch.remember(view)
        return scene


def play(
    *things: Thing,
    seconds: float,
    rate: float = 12.0,
    seed: int = 0,
    camera: Callable[[Tensor], Tensor] = handheld,
    network: Network | None = None,
    pose_error: bool = False,
    overrides: tuple[str, ...] = (),
    config: FilePath | None = None,
) -> Run:
    """Simulate a scene and let the object stage judge it.

    Args:
        things: that are in the room.
        seconds: length.
        rate: frames a second.
        seed: of noise and of the network's errors.
        camera: its true poses T_wc at times, (B,) to (B, 4, 4).
        network: how the segmentation errs; by default only the contours of its masks do.
        pose_error: whether the object stage is given poses that are off, as by `misplaced`.
        overrides: of the configuration.
        config: a file of it.
    """
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(round(seconds * rate) + 1, dtype=torch.float64) / rate
    T_wc = camera(t)
    depth, owner = render(list(things), t, T_wc)
    depth = measured(depth, generator)[:, None]
    poses = misplaced(T_wc, t, generator) if pose_error else T_wc
    network = network or Network()
    stage = ObjectStage(load_config(config, (*SCALE, *overrides)))
    frames = []
    for i, stamp in enumerate(t.tolist()):
        instances, shown = network(owner[i], list(things), stamp, generator)
        frames.append(Frame(stamp, owner[i], shown, stage(stamp, instances, depth[i], poses[i])))
    return Run(frames)
