"""Checks of frames, instances and parameters, so that wrong arguments do not fail inside a stage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import implausible_median
from v3d_torch.io.timestamps import round_timestamp
from v3d_torch.runtime.value_rules import FINITE, FRACTIONS, Rule
from v3d_torch.types import Instances, RGBDFrame, check_unit_of_stamp

_MAX_NORM_ERROR = 1e-3
"""Maximum difference between the length of a unit vector and 1."""

_MAX_TANGENT = 20.0
"""Maximum tangent of the angle between a viewing ray and the optical axis, that of 87 degrees. Undistorted positions
grow with the tangent. Where a lens model maps no ray to a pixel, the ray is arbitrary, mostly beyond this angle."""


class TensorSpec(NamedTuple):
    """Expected dtype, shape and values of a tensor.

    Attributes:
        dtype: Dtype.
        dimensions: Sizes; dimensions with the same name have the same size.
        rule: Rule for the values; None for any values.
    """

    dtype: torch.dtype
    dimensions: tuple[int | str, ...]
    rule: Rule | None = None


INSTANCES: Mapping[str, TensorSpec] = {
    "masks": TensorSpec(torch.bool, ("N", "H", "W")),
    "labels": TensorSpec(torch.int64, ("N",)),
    "scores": TensorSpec(torch.float32, ("N",), FRACTIONS),
    "boxes": TensorSpec(torch.float32, ("N", 4), FINITE),
}
"""Fields of `Instances`."""


def check_parameters(camera: object, segment: object, config: object) -> None:
    """Check the types of the parameters of `V3DSLAM`, and the field of view of the camera.

    Raises:
        ConfigError: If a parameter has the wrong type.
        InputError: If the lens model of the camera maps no ray in front of the camera to some pixels.
    """
    if not isinstance(camera, PinholeCamera):
        found = describe_type(camera)
        raise ConfigError(f"V3DSLAM needs a PinholeCamera, got {found}; give one, such as sequence.camera")
    if segment is not None and not callable(segment):
        found = describe_type(segment)
        raise ConfigError(f"V3DSLAM needs a segmenter, got {found}; give a function that takes a frame, or None")
    if not isinstance(config, Config | None):
        found = describe_type(config)
        raise ConfigError(f'V3DSLAM needs a Config, got {found}; give one, such as load_config("paper")')
    if not bool((camera.rays[..., :2].norm(dim=-1) <= _MAX_TANGENT).all()):  # also true for NaN
        raise InputError(
            f"the {camera.distortion_model} lens model of the camera gives some of the {camera.width} x {camera.height}"
            " pixels no ray within 87 degrees of the optical axis; crop the images, and subtract the offset of the crop"
            " from cx and cy, or correct focal lengths and distortion"
        )


def check_frame(frame: RGBDFrame, camera: PinholeCamera) -> None:
    """Check that a frame is complete and belongs to the camera.

    Raises:
        InputError: If the frame is not valid or of another camera.
    """
    if not isinstance(frame, RGBDFrame):
        raise InputError(
            f"expected an RGBDFrame, got {describe_type(frame)}; RGBDFrame.from_arrays makes frames from arrays"
        )
    size = (camera.height, camera.width)
    for name, image, shape, dtype in (
        ("colour", frame.image, (3, *size), torch.uint8),
        ("depth", frame.depth, (1, *size), torch.float32),
    ):
        if (wrong := describe_wrong_tensor(image, shape, dtype)) is not None:
            raise InputError(
                f"frame {frame.index}: the {name} image is {wrong}; RGBDFrame.from_arrays makes frames from arrays"
            )
    index: object = frame.index
    if not isinstance(index, Integral):
        raise InputError(f"frame {index!r}: its index is no whole number; number the frames from 0")
    times: Mapping[str, object] = {"stamp": frame.stamp, "depth delay": frame.depth_delay}
    for name, seconds in times.items():
        if not isinstance(seconds, Real) or not math.isfinite(seconds):
            raise InputError(f"frame {frame.index}: the {name} is {seconds!r}; give a finite number of seconds")
    check_unit_of_stamp(frame.index, frame.stamp)
    gravity = frame.gravity
    if gravity is not None:
        wrong = describe_wrong_tensor(gravity, (3,), torch.float64)
        if wrong is None and not abs(float(gravity.norm()) - 1) < _MAX_NORM_ERROR:
            wrong = str(gravity.tolist())
        if wrong is not None:
            raise InputError(
                f"frame {frame.index}: the gravity is {wrong}; give a unit vector in the camera frame, in float64"
            )
    if frame.camera is not None and frame.camera != camera:
        raise InputError(
            f"frame {frame.index}: its camera differs from that of the V3DSLAM; make one V3DSLAM for each camera"
        )


def check_next(frame: RGBDFrame, previous_stamp: float) -> None:
    """Check that a frame is later than the previous one, and that the depth of the first frame is in metres.

    Args:
        frame: Frame.
        previous_stamp: Time of the previous frame, seconds; minus infinity before the first.

    Raises:
        InputError: If the frame is not later, or the median depth of the first frame is implausible.
    """
    if previous_stamp == -math.inf and (median := implausible_median(frame.depth)) is not None:
        raise InputError(f"frame {frame.index}: its median depth is {median:.2g} m; give depth in metres")
    if round_timestamp(frame.stamp) <= round_timestamp(previous_stamp):
        raise InputError(
            f"frame {frame.index}: its stamp, {frame.stamp:.6f} s, is not after {previous_stamp:.6f} s, that of the"
            " previous frame; give frames in order of time, each once"
        )


def check_instances(instances: Instances, frame: RGBDFrame, labels: range) -> None:
    """Check that a segmenter returned valid instances.

    Args:
        instances: Result of the segmenter.
        frame: Frame that was segmented.
        labels: Valid labels: that of things without a class, then the classes.

    Raises:
        ConfigError: If the segmenter returned something other than valid instances.
    """
    if not isinstance(instances, Instances):
        raise ConfigError(
            f"the segmenter returned {describe_type(instances)} for frame {frame.index}; it must return Instances"
        )
    sizes = {"N": len(instances.masks), "H": frame.image.shape[-2], "W": frame.image.shape[-1]}
    for name, (dtype, dimensions, rule) in INSTANCES.items():
        value, shape = getattr(instances, name), fill_in(dimensions, sizes)
        if (wrong := describe_wrong_tensor(value, shape, dtype)) is not None:
            raise ConfigError(f"the segmenter's {name} for frame {frame.index} are {wrong}")
        if rule is not None and not rule.holds(value, sizes):
            raise ConfigError(f"the segmenter's {name} for frame {frame.index} have values that are not {rule.text}")
    if instances.track_ids is not None:
        raise ConfigError(
            f"the segmenter's track_ids for frame {frame.index} are set; leave them None, because the tracker of the"
            " objects assigns the ids"
        )
    unknown = [label for label in instances.labels.tolist() if label not in labels]
    if unknown:
        raise ConfigError(
            f"the segmenter's labels for frame {frame.index} contain {unknown[0]}, expected COCO classes from 0 to"
            f" {labels[-1]}; give other things that can move the label {labels[0]}"
        )


def fill_in(dimensions: Sequence[int | str], sizes: Mapping[str, int]) -> tuple[int | str, ...]:
    """Return a shape in which the names of dimensions whose sizes are known are replaced by the sizes."""
    return tuple(sizes.get(each, each) if isinstance(each, str) else each for each in dimensions)


def describe_wrong_tensor(value: object, shape: tuple[int | str, ...], dtype: torch.dtype) -> str | None:
    """Describe how a value differs from a CPU tensor of the expected dtype and shape.

    Args:
        value: Value.
        shape: Expected shape; a dimension with a name can have any size.
        dtype: Expected dtype.

    Returns:
        Text that follows "is" or "are" in a message; None if the value is as expected.
    """
    if not isinstance(value, Tensor):
        found = describe_type(value)
    else:
        fits = len(shape) == value.ndim and all(
            isinstance(each, str) or each == size for each, size in zip(shape, value.shape, strict=True)
        )
        if fits and (value.dtype, value.device.type) == (dtype, "cpu"):
            return None
        device = "" if value.device.type == "cpu" else f" on {value.device}"
        found = f"{value.dtype} of shape {tuple(value.shape)}{device}"
    return f"{found}, expected a tensor, {dtype} of shape ({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"


def describe_type(value: object) -> str:
    """Return the class name of a value, for messages."""
    return f"a {type(value).__qualname__}"
