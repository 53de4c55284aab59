"""Data types that several packages use: frozen dataclasses of tensors.

Conventions (see also docs/design.md): ``T_wc`` maps camera to world, ``p_w = T_wc @ p_c``; the camera looks along +z, x
points right and y down; pixel centres lie at integers and (u, v) = (column, row); depth is in metres, 0 means "no
measurement"; timestamps are in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config.validation import to_float
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_scale import estimate_depth_scale
from v3d_torch.geometry.depth_units import depth_to_metres
from v3d_torch.geometry.se3 import interpolate

MIN_INTERVAL = 0.01
"""Minimum time between two frames, seconds: RGB-D cameras send at most 90 frames per second. Closer stamps come from
a computer that received two frames at once; the true interval was longer."""

_MAX_STAMP = 1e11
"""Maximum stamp of a frame, seconds, three thousand years: a larger one is in milliseconds or nanoseconds."""

STAMP_TOLERANCE = 1e-3
"""Tolerance of time differences, seconds: timestamps are rounded and frame times jitter."""


@dataclass(frozen=True)
class RGBDFrame:
    """One colour image and its registered depth image.

    Attributes:
        index: Position in the sequence, from 0.
        stamp: Time of the colour image, seconds.
        image: Colour image with lens distortion, uint8 RGB, shape :math:`(3, H, W)`.
        depth: Depth registered to the colour image, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        camera: Camera of both images; optional, because `V3DSLAM` gets the camera separately.
        depth_delay: Time of the depth image minus time of the colour image, seconds.
        gravity: Direction of gravity, a unit vector in the camera frame, float64, shape :math:`(3,)`; None if it was
            not measured. The first frame of a sequence suffices.
    """

    index: int
    stamp: float
    image: Tensor
    depth: Tensor
    camera: PinholeCamera | None = None
    depth_delay: float = 0.0
    gravity: Tensor | None = None

    def __post_init__(self) -> None:
        # Numbers of NumPy become Python's, because a saved state has no others; V3DSLAM rejects other types.
        index: object = self.index
        if isinstance(index, Integral):
            object.__setattr__(self, "index", int(index))
        times: dict[str, object] = {"stamp": self.stamp, "depth_delay": self.depth_delay}
        for name, seconds in times.items():
            if isinstance(seconds, Real):
                object.__setattr__(self, name, float(seconds))

    @staticmethod
    def from_arrays(
        index: int,
        stamp: float,
        image: NDArray[np.uint8] | Tensor,
        depth: NDArray[np.generic] | Tensor,
        camera: PinholeCamera | None = None,
        depth_delay: float = 0.0,
        gravity: NDArray[np.float64] | Tensor | None = None,
    ) -> RGBDFrame:
        """Make a frame from images as cameras, simulators and image libraries return them.

        Args:
            index: Position in the sequence, from 0.
            stamp: Time of the colour image, seconds since any origin.
            image: Colour image, uint8 RGB, shape :math:`(H, W, 3)`; views such as ``bgr[..., ::-1]`` and PIL images
                are accepted.
            depth: Depth registered to the colour image, shape :math:`(H, W)`: metres if floating point, else in the
                units of the camera; 0 or NaN = no measurement.
            camera: Camera of both images. Its depth scale is applied to depth in whole numbers, its correction of depth
                to all depth, as for stored sequences.
            depth_delay: Time of the depth image minus time of the colour image, seconds.
            gravity: Direction of gravity in the camera frame, of any length, shape :math:`(3,)`; None if it was not
                measured. An accelerometer at rest measures the opposite direction.

        Raises:
            InputError: If an image or the gravity has the wrong shape, type or size, if depth is in whole numbers but
                the camera has no depth scale, or if a time is not a finite number of seconds.
        """
        colour, measured = _array(image), _array(depth)
        _check_arrays(index, colour, measured, camera)
        _check_times(index, stamp, depth_delay)
        scale = camera.depth_scale if camera is not None else None
        if measured.dtype.kind != "f" and scale is None:
            raise InputError(
                f"frame {index}: depth is {measured.dtype}, {estimate_depth_scale([measured]).array_prompt}"
            )
        metres = depth_to_metres(measured, scale)
        if camera is not None:
            metres = camera.correct_depth(metres)
        channels = torch.from_numpy(np.array(colour.transpose(2, 0, 1), order="C"))
        return RGBDFrame(
            index,
            to_float(stamp),
            channels,
            metres,
            camera=camera,
            depth_delay=to_float(depth_delay),
            gravity=None if gravity is None else _unit_vector(_array(gravity), index),
        )


def _check_arrays(index: int, colour: NDArray[Any], measured: NDArray[Any], camera: PinholeCamera | None) -> None:
    """Check that the images of a frame have the right shapes and types, and the size of its camera."""
    if colour.dtype != np.uint8 or colour.ndim != 3 or colour.shape[2] != 3:
        raise InputError(
            f"frame {index}: the colour image is {colour.dtype} of shape {colour.shape}; give uint8 RGB of shape"
            " (H, W, 3)"
        )
    if measured.shape != colour.shape[:2]:
        raise InputError(
            f"frame {index}: the depth image has shape {measured.shape}, the colour image {colour.shape}; give"
            " depth of shape (H, W), registered to the colour image"
        )
    if measured.dtype.kind not in "fiu":
        raise InputError(
            f"frame {index}: the depth image is {measured.dtype}; give metres in floating point, or whole numbers"
            " in the camera's units"
        )
    if not isinstance(camera, PinholeCamera | None):
        raise InputError(f"frame {index}: the camera is a {type(camera).__name__}; give a PinholeCamera")
    if camera is not None and colour.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"frame {index}: has {colour.shape[1]}x{colour.shape[0]} pixels, but the camera"
            f" {camera.width}x{camera.height}; give the camera that took it"
        )


def _check_times(index: int, stamp: float, depth_delay: float) -> None:
    """Check that the times of a frame are finite numbers of seconds."""
    for name, seconds in (("stamp", stamp), ("delay", depth_delay)):
        if not math.isfinite(to_float(seconds)):
            raise InputError(f"frame {index}: the {name} is {seconds!r}; give seconds, as a finite number")
    check_unit_of_stamp(index, stamp)


def check_unit_of_stamp(index: int, stamp: float) -> None:
    """Check that the stamp of a frame is not in milliseconds or smaller units since 1970.

    Raises:
        InputError: If it is.
    """
    if to_float(stamp) > _MAX_STAMP:
        raise InputError(f"frame {index}: the stamp is {stamp!r}, in another unit or wrong; give seconds")


def _array(values: object) -> NDArray[Any]:
    """Return an image or a vector as an array; float tensors become float32: NumPy lacks some of their dtypes."""
    if isinstance(values, Tensor):
        values = values.detach()
        return (values.to(torch.float32) if values.is_floating_point() else values).numpy()
    if isinstance(values, np.ma.MaskedArray):  # masked depth is no measurement
        return values.filled(0)
    return np.asarray(values)


def _unit_vector(vector: NDArray[Any], index: int) -> Tensor:
    """Return the direction of gravity in a frame as a unit vector."""
    if vector.shape != (3,) or vector.dtype.kind not in "fiu" or not 0 < np.linalg.norm(vector) < np.inf:
        raise InputError(f"frame {index}: the gravity is {vector.tolist()!r}; give a vector of 3 numbers, not zero")
    return torch.from_numpy(vector / np.linalg.norm(vector.astype(np.float64)))


@dataclass(frozen=True)
class Instances:
    """Instances found by the segmentation in one image, sorted by score.

    Attributes:
        masks: Pixels of each instance, bool, shape :math:`(N, H, W)`; masks can overlap.
        labels: COCO class index (0 = person, 0..79; -1 = unlabelled), int64, shape :math:`(N,)`.
        scores: Confidence in [0, 1], float32, shape :math:`(N,)`.
        boxes: Left, top, right and bottom edge, pixels, float32, shape :math:`(N, 4)`.
        track_ids: Id of the track that each instance continues, 0 if it is not known, int64, shape :math:`(N,)`; None
            if none is known, as from a segmenter.
    """

    masks: Tensor
    labels: Tensor
    scores: Tensor
    boxes: Tensor
    track_ids: Tensor | None = None

    def __len__(self) -> int:
        return self.labels.shape[0]

    def __getitem__(self, selected: Tensor) -> Instances:
        """Select instances by a boolean mask, which returns self if everything is selected, or by indices from 0."""
        if selected.dtype == torch.bool and bool(selected.all()):
            return self  # avoids a copy of the masks
        track_ids = None if self.track_ids is None else self.track_ids[selected]
        masks, boxes = self.masks[selected], self.boxes[selected]
        return Instances(masks, self.labels[selected], self.scores[selected], boxes, track_ids)

    def concatenate(self, others: Instances) -> Instances:
        """Return these instances followed by others; returns self if there are no others."""
        if len(others) == 0:
            return self
        is_known = self.track_ids is not None or others.track_ids is not None
        return Instances(
            masks=torch.cat([self.masks, others.masks]),
            labels=torch.cat([self.labels, others.labels]),
            scores=torch.cat([self.scores, others.scores]),
            boxes=torch.cat([self.boxes, others.boxes]),
            track_ids=torch.cat([self._known_ids(), others._known_ids()]) if is_known else None,
        )

    def _known_ids(self) -> Tensor:
        """Return the track ids, all 0 if none is known."""
        return torch.zeros_like(self.labels) if self.track_ids is None else self.track_ids

    @staticmethod
    def empty(height: int, width: int) -> Instances:
        """No instances in an image of ``height`` x ``width`` pixels."""
        return Instances.from_masks(torch.zeros(0, height, width, dtype=torch.bool), torch.zeros(0, dtype=torch.int64))

    @staticmethod
    def from_masks(masks: Tensor, labels: Tensor) -> Instances:
        """Instances with the score 0 and empty boxes.

        Args:
            masks: Pixels of each instance, bool, shape :math:`(N, H, W)`.
            labels: COCO class index, int64, shape :math:`(N,)`.
        """
        boxes = torch.zeros(len(masks), 4, dtype=torch.float32)
        return Instances(masks, labels, scores=boxes.new_zeros(len(masks)), boxes=boxes)


Segmenter = Callable[[RGBDFrame], Instances]
"""Finds the instances in the colour image of a frame."""


class TrackingStatus(StrEnum):
    """Source of the pose of a frame."""

    TRACKED = "tracked"
    """Tracked in the map."""
    ODOMETRY = "odometry"
    """Integrated from the motion relative to the previous or the next frame."""
    DISCONNECTED = "disconnected"
    """Tracked in a part of the map whose pose relative to the rest is only a guess."""
    LOST = "lost"
    """Not found: predicted, and interpolated after the camera is found again."""

    @property
    def is_localised(self) -> bool:
        """True if the pose is known relative to the whole map."""
        return self in (TrackingStatus.TRACKED, TrackingStatus.ODOMETRY)


TRACKING_STATUSES = tuple(TrackingStatus)
"""All statuses; tables contain the position of a status in this tuple."""


class LandmarkObserver:
    """Base class of data with the landmark id of each feature of an image.

    Attributes:
        landmarks: Landmark id of each feature, -1 for none, int64, shape :math:`(N,)`.
    """

    landmarks: Tensor

    @property
    def observed_landmarks(self) -> Tensor:
        """Ids of the observed landmarks, int64, shape :math:`(L,)`."""
        return self.landmarks[self.landmarks >= 0]

    @property
    def landmark_count(self) -> int:
        """Number of observed landmarks."""
        return len(self.observed_landmarks)


@dataclass(frozen=True)
class FramePose(LandmarkObserver):
    """Estimated pose of a frame.

    Attributes:
        status: Source of the pose.
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
        landmarks: Landmark id of each feature, -1 for none, int64, shape :math:`(N,)`.
        information: Information matrix of the left perturbation of ``T_cw``, under the assumption that the errors of
            the features are independent, float64, shape :math:`(6, 6)`; None if the pose was not tracked in the map.
        is_relocalised: True if the pose does not continue that of the previous frame: the previous frame was not
            tracked in the map, or place recognition found the camera. The change since then is no velocity.
    """

    status: TrackingStatus
    T_cw: Tensor
    landmarks: Tensor
    information: Tensor | None = None
    is_relocalised: bool = False


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time. Arrays and lists are converted to tensors.

    Attributes:
        stamps: Timestamps, seconds, float64, shape :math:`(N,)`, strictly increasing.
        T_wc: Camera-to-world poses, float64, shape :math:`(N, 4, 4)`.

    Raises:
        InputError: If the values are not numbers of these shapes, or the stamps are not finite or do not increase.
    """

    stamps: Tensor
    T_wc: Tensor

    def __post_init__(self) -> None:
        for name, shape in (("stamps", ()), ("T_wc", (4, 4))):
            given: Any = getattr(self, name)
            try:
                value = given if isinstance(given, Tensor) else torch.from_numpy(np.array(given, dtype=np.float64))
            except (TypeError, ValueError) as error:
                raise InputError(
                    f"{name} of a trajectory are not numbers ({error}); give an array or tensor"
                ) from error
            if value.shape[1:] != shape or value.ndim != 1 + len(shape) or len(value) != len(self.stamps):
                raise InputError(
                    f"{name} of a trajectory have shape {tuple(value.shape)}; give stamps of shape (N,) and poses T_wc"
                    " of shape (N, 4, 4)"
                )
            object.__setattr__(self, name, value.to(torch.float64))
        increases = self.stamps[1:] > self.stamps[:-1]
        if not bool(increases.all()):
            before, after = self.stamps[int(increases.int().argmin()) :][:2].tolist()
            raise InputError(
                f"stamps of a trajectory do not increase ({after:.6f} s follows {before:.6f} s); sort the poses by"
                " time, and give each time once and in float64"
            )
        if not bool(self.stamps.isfinite().all()):
            raise InputError("stamps of a trajectory have a value that is not finite; give seconds, or remove the pose")

    def __len__(self) -> int:
        return self.stamps.shape[0]

    def select(self, rows: slice | Sequence[int] | Tensor) -> Trajectory:
        """Return some of the poses.

        Args:
            rows: Slice, ascending indices, or mask, bool, shape :math:`(N,)`.
        """
        return Trajectory(self.stamps[rows], self.T_wc[rows])

    def poses_at(self, stamps: Tensor | Sequence[float]) -> Tensor:
        """Return the poses at given times, interpolated between the nearest poses before and after.

        Args:
            stamps: Timestamps, seconds, float64, shape :math:`(K,)`; arrays and lists are accepted. Before the first
                pose and after the last one, the camera is at rest.

        Returns:
            Camera-to-world poses, float64, shape :math:`(K, 4, 4)`.

        Raises:
            InputError: If the trajectory has no poses, or if the stamps are not numbers, or less precise than float64.
        """
        if len(self) == 0:
            raise InputError("the trajectory has no poses to interpolate; give one with at least one pose")
        stamps = _to_times(stamps)
        before = (torch.searchsorted(self.stamps, stamps, right=True) - 1).clamp(min=0)
        after = (before + 1).clamp(max=len(self) - 1)
        span = (self.stamps[after] - self.stamps[before]).clamp(min=torch.finfo(torch.float64).tiny)  # 0 at the end
        fraction = ((stamps - self.stamps[before]) / span).clamp(0, 1)
        return interpolate(self.T_wc[before], self.T_wc[after], fraction)


def _to_times(stamps: Tensor | Sequence[float]) -> Tensor:
    """Return times as float64; those of a tensor or array of lower precision are rounded, and so of another time."""
    try:
        times = stamps if isinstance(stamps, Tensor) else torch.from_numpy(np.asarray(stamps))
    except (TypeError, ValueError) as error:
        raise InputError(f"stamps are not numbers ({error}); give an array or tensor") from error
    if times.is_floating_point() and times.dtype != torch.float64:
        raise InputError(
            f"stamps have the type {times.dtype}; give torch.float64, because float32 rounds Unix times to two minutes"
        )
    return times.to(torch.float64)
