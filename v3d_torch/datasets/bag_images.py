"""Images in ROS messages to tensors."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.encodings import COLOURS, to_rgb
from v3d_torch.datasets.images import decode_colour, decode_depth, depth_to_metres
from v3d_torch.errors import InputError

_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}

_HEADER = 12
"""Bytes before the image in compressedDepth: an enumeration and the two numbers of the quantisation."""


def colour_from(message: Any, source: str) -> Tensor:
    """Colour as `RGBDFrame` holds it.

    Args:
        message: ``sensor_msgs/Image`` of 8 bits a channel, or ``CompressedImage`` of JPEG or PNG, from rosbags.
        source: of the message, for errors.

    Raises:
        InputError: the message is broken or of another kind.
    """
    if not hasattr(message, "encoding"):
        return decode_colour(message.data.tobytes(), source)
    if message.encoding not in COLOURS:
        raise InputError(
            f"{source}: holds {message.encoding} images, not colour; name another with --rgb-topic, or have them"
            f" converted to one of {', '.join(COLOURS)}"
        )
    pixels = _rows(message, np.dtype((np.uint8, COLOURS[message.encoding][0])), source)
    try:
        return to_rgb(message.encoding, pixels)
    except cv2.error as error:  # an odd width where two pixels share a colour
        size = f"{message.width}x{message.height}"
        raise InputError(f"{source}: holds no {message.encoding} image of {size} pixels; record it again") from error


def depth_from(message: Any, depth_scale: float, source: str) -> Tensor:
    """Depth as `RGBDFrame` holds it.

    Args:
        message: ``sensor_msgs/Image`` of 16-bit units or of metres, or ``CompressedImage`` of PNG, from rosbags.
        depth_scale: units per metre; ROS means millimetres (REP 118).
        source: of the message, for errors.

    Raises:
        InputError: the message is broken or of another kind.
    """
    if not hasattr(message, "encoding"):
        return _decompressed(message, depth_scale, source)
    if message.encoding not in _DEPTHS:
        raise InputError(f"{source}: holds {message.encoding} images, not depth; name another with --depth-topic")
    dtype = np.dtype((">" if message.is_bigendian else "<") + _DEPTHS[message.encoding])
    pixels = _rows(message, dtype, source)
    return _measured(pixels) if dtype.kind == "f" else depth_to_metres(pixels, depth_scale)


def _rows(message: Any, pixel: np.dtype[Any], source: str) -> NDArray[Any]:
    """Pixels (H, W) or (H, W, C) without what pads the rows."""
    used = message.width * pixel.itemsize
    if not used * message.height:
        raise InputError(f"{source}: an image has no pixels; record it again")
    if used > message.step or len(message.data) < message.step * message.height:
        size = f"{message.width}x{message.height}"
        raise InputError(f"{source}: an image has less data than its {size} pixels need; record it again")
    rows = np.asarray(message.data[: message.step * message.height]).reshape(message.height, message.step)
    flat = np.ascontiguousarray(rows[:, :used]).view(pixel.base)
    return flat.reshape(message.height, message.width, *pixel.shape)


def _decompressed(message: Any, depth_scale: float, source: str) -> Tensor:
    content = message.data.tobytes()
    if "compressedDepth" not in message.format:
        return depth_to_metres(decode_depth(content, source), depth_scale)
    if "rvl" in message.format.lower():
        raise InputError(f"{source}: depth in RVL cannot be read; republish it as PNG or raw and record that")
    units = decode_depth(content[_HEADER:], source)
    if not message.format.startswith("32FC1"):
        return depth_to_metres(units, depth_scale)
    _, a, b = struct.unpack("<iff", content[:_HEADER])
    inverse = units.astype(np.float32)  # depth is a / (inverse - b), and 0 no measurement
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return _measured(np.where(inverse > 0, a / (inverse - b), 0.0))


def _measured(pixels: NDArray[Any]) -> Tensor:
    """Metres (H, W) with NaN, infinity or less than 0 for no measurement, as `RGBDFrame` holds depth."""
    depth = torch.from_numpy(pixels.astype(np.float32))
    return torch.where(depth.isfinite() & (depth > 0), depth, 0.0).unsqueeze(0)
