"""What is refused at the door: frames and instances that callers make themselves, before they break a stage inside."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import Instances, RGBDFrame


def check_parts(camera: PinholeCamera | None, config: Config | None) -> None:
    """Look whether a system is made of what it should be.

    Raises:
        ConfigError: it is not.
    """
    if not isinstance(camera, PinholeCamera | None):
        raise ConfigError(f"the camera of a V3DSLAM is {_kind(camera)}; give a PinholeCamera, such as sequence.camera")
    if not isinstance(config, Config | None):
        raise ConfigError(f'the config of a V3DSLAM is {_kind(config)}; give a Config, such as load_config("paper")')


def check_frame(frame: RGBDFrame, camera: PinholeCamera | None) -> PinholeCamera:
    """Look whether a frame is what its class says, and of the camera that is tracked.

    Returns:
        The camera; where it was not known, that of the frame.

    Raises:
        InputError: it is not.
        ConfigError: nobody said which camera took it.
    """
    if not isinstance(frame, RGBDFrame):
        raise InputError(f"V3DSLAM takes frames, this is {_kind(frame)}; make one of arrays with RGBDFrame.of")
    camera = frame.camera if camera is None else camera
    if camera is None:
        raise ConfigError("the camera is not known: give it to V3DSLAM, or frames that carry it")
    size = (camera.height, camera.width)
    for name, image, shape, dtype in (
        ("colour", frame.image, (3, *size), torch.uint8),
        ("depth", frame.depth, (1, *size), torch.float32),
    ):
        if not isinstance(image, Tensor) or image.shape != shape or image.dtype != dtype:
            raise InputError(
                f"frame {frame.index}: the {name} image is {_said(image)}, and not a tensor, {dtype} of shape {shape}"
                " as the camera has it; RGBDFrame.of makes frames of arrays"
            )
    for name, seconds in (("stamp", frame.stamp), ("delay of depth", frame.depth_delay)):
        if not math.isfinite(seconds):
            raise InputError(f"frame {frame.index}: the {name} is {seconds}; give seconds, as a finite number")
    if frame.camera is not None and frame.camera != camera:
        raise InputError(
            f"frame {frame.index}: carries another camera than the V3DSLAM has; make one for each camera, or frames"
            " without"
        )
    return camera


def check_order(frame: RGBDFrame, last: float) -> None:
    """Look whether a frame comes after the one before it.

    Raises:
        InputError: it does not.
    """
    if frame.stamp <= last:
        raise InputError(
            f"frame {frame.index}: its stamp, {frame.stamp:.6f} s, is not after {last:.6f} s, that of the frame before;"
            " give frames in order of time, each once"
        )


def check_instances(instances: Instances, frame: RGBDFrame) -> None:
    """Look whether a segmenter gave what its signature says.

    Raises:
        ConfigError: it did not.
    """
    if not isinstance(instances, Instances):
        raise ConfigError(f"the segmenter gave {_kind(instances)} for frame {frame.index}; it has to give Instances")
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
                f"the segmenter's {name} for frame {frame.index} are {_said(value)}, and not a tensor, {dtype} of shape"
                f" {shape}"
            )


def _said(value: object) -> str:
    """What something is, in words."""
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return _kind(value)


def _kind(value: object) -> str:
    """Of which class something is, in words."""
    return f"a {type(value).__qualname__}"
