"""Checks of frames, instances and parameters that callers pass in, before they fail inside a stage."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import Instances, RGBDFrame

_MAX_NORM_ERROR = 1e-3
"""Largest difference of the length of a unit vector from 1."""


def check_parameters(camera: PinholeCamera, config: Config | None) -> None:
    """Check the types of the parameters of `V3DSLAM`.

    Raises:
        ConfigError: If a parameter has the wrong type.
    """
    if not isinstance(camera, PinholeCamera):
        raise ConfigError(f"V3DSLAM needs a PinholeCamera, got {_kind(camera)}; give one, such as sequence.camera")
    if not isinstance(config, Config | None):
        raise ConfigError(f'V3DSLAM needs a Config, got {_kind(config)}; give one, such as load_config("paper")')


def check_frame(frame: RGBDFrame, camera: PinholeCamera) -> None:
    """Check that a frame is complete and belongs to the camera.

    Raises:
        InputError: If the frame is not valid or of another camera.
    """
    if not isinstance(frame, RGBDFrame):
        raise InputError(f"expected an RGBDFrame, got {_kind(frame)}; RGBDFrame.from_arrays makes frames from arrays")
    size = (camera.height, camera.width)
    for name, image, shape, dtype in (
        ("colour", frame.image, (3, *size), torch.uint8),
        ("depth", frame.depth, (1, *size), torch.float32),
    ):
        if not isinstance(image, Tensor) or image.shape != shape or image.dtype != dtype:
            raise InputError(
                f"frame {frame.index}: the {name} image is {_description(image)}, expected a tensor, {dtype} of shape"
                f" {shape}; RGBDFrame.from_arrays makes frames from arrays"
            )
    for name, seconds in (("stamp", frame.stamp), ("depth delay", frame.depth_delay)):
        if not math.isfinite(seconds):
            raise InputError(f"frame {frame.index}: the {name} is {seconds}; give a finite number of seconds")
    gravity = frame.gravity
    if gravity is not None and (gravity.shape != (3,) or not abs(float(gravity.norm()) - 1) < _MAX_NORM_ERROR):
        raise InputError(
            f"frame {frame.index}: the gravity is {gravity.tolist()}; give a unit vector in the camera frame"
        )
    if frame.camera is not None and frame.camera != camera:
        raise InputError(
            f"frame {frame.index}: its camera differs from that of the V3DSLAM; make one V3DSLAM for each camera"
        )


def check_order(frame: RGBDFrame, previous_stamp: float) -> None:
    """Check that a frame is later than the previous one.

    Raises:
        InputError: If the frame is not later than the previous one.
    """
    if frame.stamp <= previous_stamp:
        raise InputError(
            f"frame {frame.index}: its stamp, {frame.stamp:.6f} s, is not after {previous_stamp:.6f} s, that of the"
            " previous frame; give frames in order of time, each once"
        )


def check_instances(instances: Instances, frame: RGBDFrame) -> None:
    """Check that a segmenter returned valid instances.

    Raises:
        ConfigError: If the segmenter returned something other than valid instances.
    """
    if not isinstance(instances, Instances):
        raise ConfigError(
            f"the segmenter returned {_kind(instances)} for frame {frame.index}; it must return Instances"
        )
    count, size = len(instances.masks), tuple(frame.image.shape[-2:])
    for name, shape, dtype in (
        ("masks", (count, *size), torch.bool),
        ("labels", (count,), torch.int64),
        ("scores", (count,), torch.float32),
        ("boxes", (count, 4), torch.float32),
    ):
        value = getattr(instances, name)
        if not isinstance(value, Tensor) or value.shape != shape or value.dtype != dtype:
            raise ConfigError(
                f"the segmenter's {name} for frame {frame.index} are {_description(value)}, expected a tensor, {dtype}"
                f" of shape {shape}"
            )


def _description(value: object) -> str:
    """Return the type and shape of a value in words."""
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return _kind(value)


def _kind(value: object) -> str:
    """Return the class of a value in words."""
    return f"a {type(value).__qualname__}"
