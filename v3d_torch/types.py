"""The data that flows between stages: frozen dataclasses of tensors.

Conventions (see also docs/design.md): ``T_wc`` maps camera to world, ``p_w = T_wc @ p_c``; the camera looks
along +z with x right and y down; pixel centres lie at integers and (u, v) = (column, row); depth is in metres and 0
means "no measurement"; stamps are seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from v3d_torch.config.validation import to_float
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera


@dataclass(frozen=True)
class RGBDFrame:
    """One colour image and the depth image that belongs to it.

    Attributes:
        index: position in the sequence, from 0.
        stamp: time of the colour image, seconds.
        image: colour, uint8 RGB, shape :math:`(3, H, W)`, as the camera delivers it (distorted).
        depth: metres, float32, shape :math:`(1, H, W)`, pixel by pixel on the colour image; 0 = no measurement.
        camera: that took both; None where who takes the frame in knows it.
        delay: of the depth image, seconds after the colour image; less than 0 where it was taken before.
    """

    index: int
    stamp: float
    image: Tensor
    depth: Tensor
    camera: PinholeCamera | None = None
    depth_delay: float = 0.0

    @staticmethod
    def from_arrays(
        index: int,
        stamp: float,
        image: NDArray[np.uint8] | Tensor,
        depth: NDArray[np.generic] | Tensor,
        camera: PinholeCamera | None = None,
        depth_delay: float = 0.0,
    ) -> RGBDFrame:
        """A frame from images as cameras, simulators and image libraries give them.

        Args:
            index: position in the sequence, from 0.
            stamp: seconds.
            image: colour, uint8 RGB, shape :math:`(H, W, 3)`; also a view such as ``bgr[..., ::-1]``, or of PIL.
            depth: pixel by pixel on it, shape :math:`(H, W)`: metres where it is a floating-point image, else the
                camera's units; 0 or not a number = no measurement.
            camera: that took both; gives the units of depth, millimetres where there is none.
            delay: of the depth image, seconds after the colour image.

        Raises:
            InputError: an image has another shape or type, or another size than the camera's; stamp or delay is no
                number.
        """
        colour, measured = _array(image), _array(depth)
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
        for name, seconds in (("stamp", stamp), ("delay", depth_delay)):
            if not math.isfinite(to_float(seconds)):
                raise InputError(f"frame {index}: the {name} is {seconds!r}; give seconds, as a finite number")
        if not isinstance(camera, PinholeCamera | None):
            raise InputError(f"frame {index}: the camera is a {type(camera).__name__}; give a PinholeCamera")
        if camera is not None and colour.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"frame {index}: has {colour.shape[1]}x{colour.shape[0]} pixels, the camera"
                f" {camera.width}x{camera.height}; give the camera that took it"
            )
        metres = torch.from_numpy(measured.astype(np.float32))
        if measured.dtype.kind != "f":
            metres = metres / (camera.depth_scale if camera is not None else 1000)
        metres = metres.where(metres.isfinite() & (metres > 0), 0.0)
        channels = torch.from_numpy(np.array(colour.transpose(2, 0, 1), order="C"))
        return RGBDFrame(
            index, to_float(stamp), channels, metres[None], camera=camera, depth_delay=to_float(depth_delay)
        )


def _array(image: object) -> NDArray[Any]:
    """An image as an array: a tensor may be of a type that NumPy has not, or wait for gradients."""
    if isinstance(image, Tensor):
        image = image.detach()
        return (image.to(torch.float32) if image.is_floating_point() else image).numpy()
    return np.asarray(image)


@dataclass(frozen=True)
class Instances:
    """What the segmentation sees in one image, best score first.

    Attributes:
        masks: bool, shape :math:`(N, H, W)`; masks may overlap.
        labels: COCO class index (0 = person, 0..79; -1 = unnamed), int64, shape :math:`(N,)`.
        scores: float32 in [0, 1], shape :math:`(N,)`.
        boxes: float32, shape :math:`(N, 4)`: left, top, right, bottom in pixels.
    """

    masks: Tensor
    labels: Tensor
    scores: Tensor
    boxes: Tensor

    def __len__(self) -> int:
        return self.labels.shape[0]

    def __getitem__(self, keep: Tensor) -> Instances:
        """Instances chosen by a boolean mask; all of them are these themselves, as masks take long to copy."""
        if bool(keep.all()):
            return self
        return Instances(self.masks[keep], self.labels[keep], self.scores[keep], self.boxes[keep])

    def concatenate(self, others: Instances) -> Instances:
        """These instances, then the others; without others, these themselves."""
        if len(others) == 0:
            return self
        return Instances(
            masks=torch.cat([self.masks, others.masks]),
            labels=torch.cat([self.labels, others.labels]),
            scores=torch.cat([self.scores, others.scores]),
            boxes=torch.cat([self.boxes, others.boxes]),
        )

    @staticmethod
    def empty(height: int, width: int) -> Instances:
        """No instances in an image of ``height`` x ``width`` pixels."""
        return Instances(
            masks=torch.zeros(0, height, width, dtype=torch.bool),
            labels=torch.zeros(0, dtype=torch.int64),
            scores=torch.zeros(0),
            boxes=torch.zeros(0, 4),
        )


Segmenter = Callable[[RGBDFrame], Instances]
"""Finds the instances in a frame's colour image."""


@runtime_checkable
class PoseAwareSegmenter(Protocol):
    """A segmenter that also uses the predicted pose of the camera, for example to find the up direction."""

    def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
        """Segment a frame.

        Args:
            frame: Frame to segment.
            T_cw: Predicted world-to-camera pose of the frame, float64, shape :math:`(4, 4)`; None if it is unknown.

        Returns:
            Instances in the frame's colour image.
        """


@runtime_checkable
class StatefulSegmenter(Protocol):
    """A segmenter whose results depend on earlier frames.

    The state consists of tensors and plain Python values. An identically configured segmenter that loads it continues
    with the same results. An `nn.Module` is never treated as stateful, because its ``state_dict`` holds its weights.
    """

    def state_dict(self) -> dict[str, Any]:
        """Return a snapshot of the state; no tensor in it is changed in place later."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that `state_dict` returned."""


def segment_frame(segmenter: Segmenter, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
    """Segment a frame; only a `PoseAwareSegmenter` receives the predicted pose.

    Args:
        segmenter: Segmenter to call.
        frame: Frame to segment.
        T_cw: Predicted world-to-camera pose of the frame, float64, shape :math:`(4, 4)`; None if it is unknown.

    Returns:
        Instances in the frame's colour image.
    """
    pose_aware = cast("PoseAwareSegmenter", segmenter)
    return pose_aware.segment_with_pose(frame, T_cw) if _has(segmenter, "segment_with_pose") else segmenter(frame)


def segmenter_state_of(segmenter: object) -> dict[str, Any] | None:
    """Return the state of a `StatefulSegmenter`, None for any other segmenter."""
    return cast("StatefulSegmenter", segmenter).state_dict() if _is_stateful(segmenter) else None


def restore_segmenter(segmenter: object, state: Mapping[str, Any] | None) -> None:
    """Load a state that `segmenter_state_of` returned; do nothing if the state is None."""
    if state is not None and _is_stateful(segmenter):
        cast("StatefulSegmenter", segmenter).load_state_dict(state)


def _is_stateful(segmenter: object) -> bool:
    # The state_dict of a torch module holds its weights: constant, and too large to be copied after every frame.
    return _has(segmenter, "state_dict", "load_state_dict") and not isinstance(segmenter, nn.Module)


def _has(segmenter: object, *methods: str) -> bool:
    """Check for methods by name: from Python 3.12 on, isinstance does not find those that a proxy forwards."""
    return all(callable(getattr(segmenter, method, None)) for method in methods)


class TrackingStatus(StrEnum):
    """How a frame's pose was found."""

    TRACKED = "tracked"  # in the map
    ODOMETRY = "odometry"  # by its motion since the frame before, or to the one after
    DISCONNECTED = "disconnected"  # in a part of the map that only a guess joins to the rest
    LOST = "lost"  # not at all: predicted, and interpolated once the camera is found again


@dataclass(frozen=True)
class FramePose:
    """A frame's pose as it was found.

    Attributes:
        status: how.
        T_cw: world to camera, float64, shape :math:`(4, 4)`.
        landmarks: id of the landmark behind each feature, -1 for none, int64, shape :math:`(N,)`.
    """

    status: TrackingStatus
    T_cw: Tensor
    landmarks: Tensor

    @property
    def count(self) -> int:
        """Number of landmarks found."""
        return int((self.landmarks >= 0).sum())


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time. Arrays, and lists of them, become tensors.

    Attributes:
        stamps: seconds, float64, shape :math:`(N,)`, strictly increasing.
        T_wc: camera-to-world, float64, shape :math:`(N, 4, 4)`.

    Raises:
        InputError: they are not numbers of these shapes.
    """

    stamps: Tensor
    T_wc: Tensor

    def __post_init__(self) -> None:
        for name, shape in (("stamps", ()), ("T_wc", (4, 4))):
            given: Any = getattr(self, name)
            try:
                value = given if isinstance(given, Tensor) else torch.from_numpy(np.array(given, dtype=np.float64))
            except (TypeError, ValueError) as error:
                raise InputError(f"{name} of a trajectory are no numbers ({error}); give an array or tensor") from error
            if value.shape[1:] != shape or value.ndim != 1 + len(shape) or len(value) != len(self.stamps):
                raise InputError(
                    f"{name} of a trajectory have the shape {tuple(value.shape)}; give stamps of shape (N,) and as many"
                    " poses T_wc of shape (N, 4, 4)"
                )
            object.__setattr__(self, name, value.to(torch.float64))

    def __len__(self) -> int:
        return self.stamps.shape[0]
