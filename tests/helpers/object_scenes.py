"""Simulated rooms for the object stage: people and furniture, a handheld depth camera, and an imperfect network.

The world frame is a camera frame at rest: x right, y down, z forward, metres. Images have a quarter of the usual
resolution. This is the resolution of a network's masks, so that an error of one mask pixel is one pixel here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path as FilePath
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from v3d_torch.config import ObjectsConfig
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
SCALE = ("objects.clouds.stride=1", "objects.static_mask.depth_margin=2")  # for the smaller images
WALL, FLOOR = 5.0, 1.2
PERSON, DOG, CHAIR, COUCH, TABLE, TV = 0, 16, 56, 57, 60, 62
MIN_PIXELS = 60  # smallest object that the network detects: 31 x 31 pixels of an image of the usual size

Vector = tuple[float, float, float]
Path = Callable[[Tensor], Tensor]  # times, seconds, (B,), to positions, metres, (B, 3)


# ---------------------------------------------------------------- contents of a room


@dataclass(frozen=True)
class Part:
    """Axis-aligned box, or the upright elliptic cylinder inscribed in it.

    Attributes:
        half: Half of the side lengths, metres.
        centre: Path of the centre.
        round: True for the cylinder.
    """

    half: Vector
    centre: Path
    round: bool = False


@dataclass(frozen=True)
class Thing:
    """Object made of parts. The network has no class for a thing without a label."""

    label: int | None
    parts: tuple[Part, ...]


def stand(x: float, z: float, y: float = FLOOR) -> Path:
    return lambda t: torch.tensor([x, y, z]).expand(len(t), 3)


def walk(x: float, z: float, vx: float, vz: float, start: float = 0.0, stop: float = math.inf) -> Path:
    """Path on the floor from (x, z) with constant velocity between two times."""

    def position(t: Tensor) -> Tensor:
        elapsed = t.clamp(start, stop) - start
        return torch.stack([x + vx * elapsed, torch.full_like(t, FLOOR), z + vz * elapsed], dim=-1)

    return position


def shift(path: Path, dx: Callable[[Tensor], Tensor] | float, dy: float, dz: float = 0.0) -> Path:
    """Path with an offset from another path; ``dx`` can change with time."""

    def position(t: Tensor) -> Tensor:
        offset = dx(t) if callable(dx) else torch.full_like(t, dx)
        return path(t) + torch.stack([offset, torch.full_like(t, dy), torch.full_like(t, dz)], dim=-1)

    return position


def furniture(label: int | None, path: Path, size: Vector) -> Thing:
    """Box whose underside follows the path."""
    return Thing(label, (Part(tuple(side / 2 for side in size), shift(path, 0.0, -size[1] / 2)),))  # type: ignore[arg-type]


def chair(path: Path, label: int = CHAIR) -> Thing:
    """Chair with seat and back, 0.85 m high."""
    seat = Part((0.23, 0.23, 0.23), shift(path, 0.0, -0.23))
    back = Part((0.23, 0.2, 0.04), shift(path, 0.0, -0.65, 0.19))
    return Thing(label, (seat, back))


def person(path: Path, stride: float = 0.0, phase: float = 0.0, wave: float = 0.0, seated: bool = False) -> Thing:
    """Person 1.73 m tall with trunk, head and legs, and with arms if they wave.

    Args:
        path: Path of the point between the feet.
        stride: Amplitude of the legs' swing at 1 Hz, metres.
        phase: Phase of the swing, radians.
        wave: Amplitude of the arms' sideways motion at 1 Hz, metres.
        seated: True for a person on a stool with the thighs towards the camera.
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


# ---------------------------------------------------------------- the depth camera


def still_camera(t: Tensor) -> Tensor:
    return torch.eye(4, dtype=torch.float64).expand(len(t), 4, 4)


def handheld(t: Tensor) -> Tensor:
    """Camera of a person who stands: it shakes by a centimetre and a degree."""
    waves = [torch.sin(2 * math.pi * rate * t + start) for rate, start in ((1.1, 0.0), (0.7, 1.0), (1.7, 2.0))]
    shake = torch.stack([*waves, *waves], dim=-1)
    return se3_exp(shake * torch.tensor([0.012, 0.012, 0.008, 0.012, 0.018, 0.01], dtype=torch.float64))


def roaming(t: Tensor) -> Tensor:
    """Camera of a person who walks: 0.35 m/s sideways, 0.15 m/s forward, turning by 0.2 rad/s, and shaking."""
    rates = torch.tensor([0.35, 0.0, 0.15, 0.0, -0.2, 0.02], dtype=torch.float64)
    start = torch.tensor([-0.3, 0.0, -0.1, 0.0, 0.2, 0.0], dtype=torch.float64)
    return se3_exp(start + t[:, None] * rates) @ handheld(t)


def render(things: list[Thing], t: Tensor, T_wc: Tensor) -> tuple[Tensor, Tensor]:
    """Return the true depth, metres, and the thing at each pixel, -1 = the room, both of shape (B, H, W)."""
    origin = T_wc[:, None, None, :3, 3].float()
    direction = torch.einsum("bij,hwj->bhwi", T_wc[:, :3, :3].float(), CAMERA.rays)  # of unit depth
    floor = (FLOOR - origin[..., 1]) / direction[..., 1]
    depth = torch.where(floor > 0, floor, math.inf).minimum((WALL - origin[..., 2]) / direction[..., 2])
    owner = torch.full(depth.shape, -1)
    for i, thing in enumerate(things):
        for part in thing.parts:
            centre = part.centre(t)
            rows, columns = _window(part, centre, T_wc)
            hit = _entry_depth(part, centre.float()[:, None, None] - origin, direction[:, rows, columns])
            nearer = (hit > 0.1) & (hit < depth[:, rows, columns])
            depth[:, rows, columns] = torch.where(nearer, hit, depth[:, rows, columns])
            owner[:, rows, columns][nearer] = i
    return depth, owner


def _window(part: Part, centre: Tensor, T_wc: Tensor) -> tuple[slice, slice]:
    """Return the rows and columns of the image that contain a part in all frames."""
    corners = centre[:, None] + torch.cartesian_prod(*(torch.tensor([-half, half]) for half in part.half))
    in_camera = (corners - T_wc[:, None, :3, 3]) @ T_wc[:, :3, :3]
    if bool((in_camera[..., 2] < 0.1).any()):
        return slice(None), slice(None)
    low, high = CAMERA.project(in_camera).flatten(0, 1).aminmax(dim=0)
    (left, top), (right, bottom) = low.clamp(min=0).floor().int().tolist(), high.clamp(min=0).ceil().int().tolist()
    return slice(top, bottom + 1), slice(left, right + 1)


def _entry_depth(part: Part, centre: Tensor, direction: Tensor) -> Tensor:
    """Return the depth at which rays enter a part, inf for rays that miss it, (B, H, W)."""
    half = torch.tensor(part.half)
    sides = torch.stack([(centre - half) / direction, (centre + half) / direction])
    enter, leave = sides.amin(dim=0), sides.amax(dim=0)
    if part.round:  # x and z together: |direction * s - centre| = 1 in units of the radii
        d, c = (direction / half)[..., ::2], (centre / half)[..., ::2]
        square, middle = (d * d).sum(-1), (d * c).sum(-1)
        root = (middle.square() - square * ((c * c).sum(-1) - 1)).sqrt()  # NaN if the ray misses
        enter = torch.stack([(middle - root) / square, enter[..., 1]], dim=-1)
        leave = torch.stack([(middle + root) / square, leave[..., 1]], dim=-1)
    first, last = enter.amax(dim=-1), leave.amin(dim=-1)
    return torch.where(first <= last, first, math.inf)


def measure_depth(depth: Tensor, generator: torch.Generator) -> Tensor:
    """Simulate the depth of a structured-light camera (Khoshelham and Elberink, Sensors 2012), shape as the input.

    The error is 0.0014 z^2, and disparity is quantised to eighths of a pixel. Half of the pixels beside a depth edge
    are lost, and some pixels anywhere.
    """
    noisy = depth + 0.0014 * depth.square() * torch.randn(depth.shape, generator=generator)
    step = 0.00285  # 1/m: an eighth of a pixel at 580 pixels and 0.075 m
    quantised = 1 / (step * (1 / (step * noisy)).round())
    square = np.ones((3, 3), np.uint8)
    farthest, nearest = (
        torch.from_numpy(np.stack([extreme(image, square) for image in depth.numpy()]))
        for extreme in (cv2.dilate, cv2.erode)
    )
    edge = farthest > 1.06 * nearest
    lost = torch.rand(depth.shape, generator=generator) < 0.01 + 0.49 * edge
    return torch.where(lost, 0.0, quantised)


def perturb_poses(T_wc: Tensor, t: Tensor, generator: torch.Generator) -> Tensor:
    """Simulate the poses of odometry: an error of 3 mm and 0.2 degrees in each frame, and a drift of 1 cm/s."""
    sigma = torch.tensor([0.003] * 3 + [math.radians(0.2)] * 3, dtype=torch.float64) / math.sqrt(3)
    error = sigma * torch.randn(len(t), 6, generator=generator, dtype=torch.float64)
    error[:, 0] += 0.01 * t
    return T_wc @ se3_exp(error)


# ---------------------------------------------------------------- the segmentation network


@dataclass(frozen=True)
class Network:
    """Errors of the segmentation.

    The magnitudes are those of a real network on static things before a static camera: from frame to frame, a contour
    varies by a fraction of a mask pixel, and some masks of a chair lack a third of it.

    Attributes:
        contour: Standard deviation of a contour, pixels; errors of neighbouring parts are correlated.
        bite: Probability that a mask lacks a third of its object, at one of the four sides.
        missed: True if a thing is missed at a time, seconds.
        flicker: Second class of a thing, and its probability.
        shuffled: True for instances in an order that changes from frame to frame, False for the order of the things.
    """

    contour: float = 0.3
    bite: float = 0.0
    missed: Callable[[int, float], bool] = lambda thing, t: False
    flicker: dict[int, tuple[int, float]] = field(default_factory=dict)
    shuffled: bool = False

    def __call__(
        self, owner: Tensor, things: list[Thing], t: float, generator: torch.Generator
    ) -> tuple[Instances, list[int]]:
        """Return the instances of an image, and the thing of each."""
        pixels = torch.bincount(owner.flatten() + 1, minlength=len(things) + 1)[1:]
        detected = [
            i
            for i, thing in enumerate(things)
            if thing.label is not None and int(pixels[i]) >= MIN_PIXELS and not self.missed(i, t)
        ]
        if self.shuffled:
            detected = [detected[i] for i in torch.randperm(len(detected), generator=generator).tolist()]
        if not detected:
            return Instances.empty(*owner.shape), []
        masks = torch.stack([self._predict_mask(owner == i, generator) for i in detected])
        labels = torch.tensor([self._predict_label(i, things[i], generator) for i in detected])
        boxes = torch.stack([_bounding_box(mask) for mask in masks])
        return Instances(masks, labels, torch.linspace(0.9, 0.5, len(detected)), boxes), detected

    def _predict_mask(self, mask: Tensor, generator: torch.Generator) -> Tensor:
        bite, side = torch.rand(2, generator=generator).tolist()
        if bite < self.bite:
            mask = mask & ~_third(mask, int(4 * side))
        inside, outside = (
            cv2.distanceTransform(part.to(torch.uint8).numpy(), cv2.DIST_L2, 3) for part in (mask, ~mask)
        )
        coarse = torch.randn(mask.shape[0] // 8, mask.shape[1] // 8, generator=generator)
        rows, columns = map(_bicubic_weights, coarse.shape, mask.shape)
        error = self.contour * rows @ coarse @ columns.T
        # Distances are to the nearest pixel of the other kind; the contour lies half a pixel before this pixel.
        return torch.from_numpy(inside - outside) - 0.5 * (2 * mask.float() - 1) > error

    def _predict_label(self, i: int, thing: Thing, generator: torch.Generator) -> int:
        other, probability = self.flicker.get(i, (thing.label, 0.0))
        label = other if float(torch.rand((), generator=generator)) < probability else thing.label
        assert label is not None
        return label


@cache
def _bicubic_weights(size: int, new_size: int) -> Tensor:
    """Weights of bicubic interpolation along one axis, of shape (new_size, size)."""
    return interpolate(torch.eye(size)[None, None], (new_size, size), mode="bicubic")[0, 0]


def _bounding_box(mask: Tensor) -> Tensor:
    """Return left, top, right and bottom."""
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    if len(rows) == 0:
        return torch.zeros(4)
    return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()[:, 0]


def _third(mask: Tensor, side: int) -> Tensor:
    """Return the third of an object's bounding box at one of its sides: left, top, right, bottom."""
    left, top, right, bottom = _bounding_box(mask).tolist()
    v, u = torch.meshgrid(torch.arange(mask.shape[0]), torch.arange(mask.shape[1]), indexing="ij")
    third = [u < left + (right - left) / 3, v < top + (bottom - top) / 3]
    return [*third, u >= right - (right - left) / 3, v >= bottom - (bottom - top) / 3][side]


# ---------------------------------------------------------------- the object stage


@dataclass(frozen=True)
class Frame:
    """Ground truth of one frame, and the result of the object stage.

    Attributes:
        stamp: Timestamp, seconds.
        owner: Thing at each pixel, -1 = the room, int64, shape (H, W).
        detected: Things that the network detected.
        result: Result of the object stage.
    """

    stamp: float
    owner: Tensor
    detected: list[int]
    result: FrameObjects
    _found: dict[int, TrackedObject | None] = field(default_factory=dict)

    def find(self, thing: int) -> TrackedObject | None:
        """Return the detected object that best overlaps the visible part of a thing, None without a clear overlap."""
        if thing not in self._found:
            overlaps = [(self.overlap(obj, thing), obj) for obj in self.result.objects if not obj.missed]
            overlap, best = max(overlaps, key=lambda pair: pair[0], default=(0.0, None))
            self._found[thing] = best if overlap >= 0.3 else None
        return self._found[thing]

    def visible_pixels(self, thing: int) -> int:
        """Return the number of visible pixels of a thing."""
        return int((self.owner == thing).sum())

    def overlap(self, obj: TrackedObject, thing: int) -> float:
        """Return the intersection over union of an object's mask and the visible part of a thing."""
        truth = self.owner == thing
        return float((obj.mask & truth).sum() / (obj.mask | truth).sum().clamp(min=1))


@dataclass(frozen=True)
class Run:
    """Frames of a scene. For a thing, only frames count in which it is detected and at least a quarter is visible."""

    frames: list[Frame]

    def counted_frames(self, thing: int, since: float = 0.0, until: float = math.inf) -> list[Frame]:
        """Return the frames that count for a thing, between two times in seconds."""
        quarter = max(frame.visible_pixels(thing) for frame in self.frames) / 4
        within = [frame for frame in self.frames if since <= frame.stamp <= until]
        frames = [frame for frame in within if thing in frame.detected and frame.visible_pixels(thing) >= quarter]
        assert len(frames) >= 3, f"thing {thing} is hardly visible between {since} and {until} s"
        return frames

    def state_fraction(self, thing: int, *states: MotionState, since: float = 0.0, until: float = math.inf) -> float:
        """Return the fraction of frames in which a thing is found with one of some motion states."""
        objects = [frame.find(thing) for frame in self.counted_frames(thing, since, until)]
        return sum(obj is not None and obj.motion_state in states for obj in objects) / len(objects)

    def ids(self, thing: int, since: float = 0.0, until: float = math.inf) -> set[int]:
        """Return all ids of a thing."""
        frames = self.counted_frames(thing, since, until)
        return {obj.id for frame in frames if (obj := frame.find(thing)) is not None}

    def static_fraction(self, thing: int, since: float = 0.0) -> float:
        """Return the fraction of a thing's pixels that are in the static mask."""
        frames = self.counted_frames(thing, since)
        return float(torch.cat([frame.result.static_mask[frame.owner == thing] for frame in frames]).double().mean())


def support_without_residuals(pixel: Tensor, inliers: Tensor) -> FeatureSupport:
    """Return features whose displacement is not known."""
    return FeatureSupport(pixel, inliers, torch.full((len(pixel), 2), torch.nan, dtype=torch.float64))


NO_FEATURES = support_without_residuals(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0, dtype=torch.bool))
"""Feature support of a frame without features: the simulated scenes have depth only."""


GUESS_ERROR = se3_exp(torch.tensor([0.2, 0.05, 0.15, 0.0, 0.08, 0.02], dtype=torch.float64))
"""Transform from the true world frame to that of guessed poses: 25 cm and 5 degrees."""


@dataclass(frozen=True)
class Guess:
    """Pose that the object stage is given.

    Attributes:
        T_wc: Camera-to-world pose, float64, shape (4, 4).
        is_measured: False if the motion since the previous frame was not measured.
        is_found: True if the camera is found in the map afterwards, so that the true pose is known.
    """

    T_wc: Tensor
    is_measured: bool = True
    is_found: bool = True


class ObjectStage:
    """Object stage in the order of `V3DSLAM`.

    Attributes:
        instances: Instances of the last frame, the unlabelled ones included.
        feature_support: Features of the next frame.
    """

    def __init__(self, config: ObjectsConfig, camera: PinholeCamera = CAMERA) -> None:
        self._config = config
        self._camera = camera
        self._free_space_check = FreeSpaceCheck(config.free_space, camera)
        self._back_project = InstanceBackProjector(config.clouds, camera)
        self._classify = MotionClassifier(config, camera)
        self.instances = Instances.empty(camera.height, camera.width)
        self.feature_support = NO_FEATURES
        self._is_lost = False

    def __call__(
        self,
        stamp: float,
        instances: Instances | None,
        depth: Tensor,
        T_wc: Tensor,
        cloud_depth: Tensor | None = None,
        guess: Guess | None = None,
    ) -> FrameObjects:
        """Process a frame; None for its instances if it is not segmented.

        The clouds use ``cloud_depth`` if it is given, everything else uses ``depth``.
        """
        guess = guess or Guess(T_wc)
        view = self._free_space_check.make_view(stamp, depth, invert(guess.T_wc), is_motion_measured=guess.is_measured)
        appeared_pixels = self._free_space_check(view, pose_known=guess.is_measured and not self._is_lost)
        if instances is None:
            instances = self._classify.propagate_instances(view)
        min_area = self._config.free_space.min_unlabelled_area
        unlabelled = unlabelled_instances(appeared_pixels, instances, depth, self._camera, min_area)
        self.instances = instances.concatenate(unlabelled)
        clouds = self._back_project(depth if cloud_depth is None else cloud_depth, self.instances)
        result = self._classify(self.instances, clouds, view, appeared_pixels, self.feature_support)
        self._is_lost = not guess.is_found
        if guess.is_found:
            self._free_space_check.add_view(view, invert(T_wc))
            self._classify.add_view(view, invert(T_wc), result.map_mask)
            self._classify.move_to_map(T_wc @ invert(guess.T_wc))
        return result

    def move_world(self, T_new_old: Tensor) -> None:
        """Apply a correction of the world."""
        self._classify.apply_world_correction(T_new_old)
        self._free_space_check.apply_world_correction(T_new_old)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of all parts."""
        return {"free_space_check": self._free_space_check.state_dict(), "classify": self._classify.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Replace the state of all parts."""
        self._free_space_check.load_state_dict(state["free_space_check"])
        self._classify.load_state_dict(state["classify"])


def simulate(
    *things: Thing,
    seconds: float,
    rate: float = 12.0,
    seed: int = 0,
    camera: Callable[[Tensor], Tensor] = handheld,
    network: Network | None = None,
    pose_error: bool = False,
    guessed: range = range(0),
    unmeasured: Container[int] | None = None,
    overrides: tuple[str, ...] = (),
    config: FilePath | None = None,
) -> Run:
    """Simulate a scene and run the object stage on it.

    Args:
        things: Things in the room.
        seconds: Length of the run, seconds.
        rate: Frame rate, Hz.
        seed: Seed of the noise and of the network's errors.
        camera: True camera-to-world poses at given times, (B,) to (B, 4, 4).
        network: Errors of the segmentation; contour errors only by default.
        pose_error: True to pass poses with the error of `perturb_poses`.
        guessed: Frames with a guessed pose; the camera is found again in the last one.
        unmeasured: Those of them before which the motion is not measured; None for the first one. Each guess has an
            error of its own.
        overrides: Overrides of the configuration.
        config: Configuration file.
    """
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(round(seconds * rate) + 1, dtype=torch.float64) / rate
    T_wc = camera(t)
    true_depth, owner = render(list(things), t, T_wc)
    depth = measure_depth(true_depth, generator)[:, None]
    poses = perturb_poses(T_wc, t, generator) if pose_error else T_wc
    network = network or Network()
    settings = load_config(config, (*SCALE, *overrides))
    smooth = DepthSmoother(settings.depth.kernel_size, settings.depth.sigma, settings.depth.edge_ratio)
    stage = ObjectStage(settings.objects)
    frames, error = [], torch.eye(4, dtype=torch.float64)
    for i, stamp in enumerate(t.tolist()):
        instances, detected = network(owner[i], list(things), stamp, generator)
        guess = None
        if i in guessed:
            is_measured = i not in (guessed[:1] if unmeasured is None else unmeasured)
            error = error if is_measured else GUESS_ERROR @ error
            guess = Guess(error @ poses[i], is_measured, is_found=i + 1 == guessed.stop)
        result = stage(stamp, instances, smooth(depth[i][None])[0], poses[i], guess=guess)
        frames.append(Frame(stamp, owner[i], detected, result))
    return Run(frames)
