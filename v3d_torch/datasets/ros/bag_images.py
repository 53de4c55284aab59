"""Conversion of ROS image messages to tensors."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.images import decode_colour, decode_depth
from v3d_torch.datasets.ros.encodings import COLOUR_ENCODINGS, convert_to_rgb
from v3d_torch.errors import InputError

_DEPTH_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""NumPy type of a pixel, without byte order."""

_DEPTH_HEADER = struct.Struct("<iff")
"""Header of a compressedDepth image: an enumeration and the two quantisation parameters of floating-point depth."""


def decode_colour_message(message: Any, source: str) -> Tensor:
    """Decode a ROS colour image.

    Args:
        message: ``sensor_msgs/Image`` with 8 bits per channel, or ``CompressedImage`` with JPEG or PNG, from rosbags.
        source: Bag and topic of the message, for error messages.

    Returns:
        RGB image, uint8, shape :math:`(3, H, W)`.

    Raises:
        InputError: If the image is damaged or is not a colour image.
    """
    if not hasattr(message, "encoding"):
        return decode_colour(message.data.tobytes(), source)
    if message.encoding not in COLOUR_ENCODINGS:
        raise InputError(
            f"{source}: holds {message.encoding} images, not colour; choose another topic with --rgb-topic, or convert"
            f" the images to one of {', '.join(COLOUR_ENCODINGS)}"
        )
    pixels = _unpad_rows(message, np.dtype((np.uint8, COLOUR_ENCODINGS[message.encoding][0])), source)
    try:
        return convert_to_rgb(message.encoding, pixels)
    except cv2.error as error:  # for example, an odd width in an encoding that shares chroma between two columns
        size = f"{message.width}x{message.height}"
        raise InputError(
            f"{source}: an image of {size} pixels is not valid {message.encoding}; record the bag again"
        ) from error


def decode_depth_message(message: Any, source: str) -> NDArray[np.generic]:
    """Decode a ROS depth image.

    Args:
        message: ``sensor_msgs/Image`` with 16-bit integers or float metres, or ``CompressedImage`` with PNG, from
            rosbags.
        source: Bag and topic of the message, for error messages.

    Returns:
        16-bit depth in its unit, or depth in metres in floating point, shape (H, W). Values that are not positive or
        not finite are not measurements.

    Raises:
        InputError: If the image is damaged or is not a depth image.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed_depth(message, source)
    if message.encoding not in _DEPTH_ENCODINGS:
        raise InputError(
            f"{source}: holds {message.encoding} images, not depth; choose another topic with --depth-topic"
        )
    dtype = np.dtype((">" if message.is_bigendian else "<") + _DEPTH_ENCODINGS[message.encoding])
    return _unpad_rows(message, dtype, source)


def _unpad_rows(message: Any, pixel: np.dtype[Any], source: str) -> NDArray[Any]:
    """Return the pixels, shape (H, W) or (H, W, C), without the padding at the end of each row."""
    row_bytes = message.width * pixel.itemsize
    if not row_bytes * message.height:
        raise InputError(f"{source}: an image has no pixels; record the bag again")
    if row_bytes > message.step or len(message.data) < message.step * message.height:
        size = f"{message.width}x{message.height}"
        raise InputError(f"{source}: an image has less data than its {size} pixels need; record the bag again")
    rows = np.asarray(message.data[: message.step * message.height]).reshape(message.height, message.step)
    flat = np.ascontiguousarray(rows[:, :row_bytes]).view(pixel.base)
    return flat.reshape(message.height, message.width, *pixel.shape)


def _decode_compressed_depth(message: Any, source: str) -> NDArray[np.generic]:
    """Decode a ``CompressedImage`` of the transports compressed and compressedDepth."""
    content = message.data.tobytes()
    if "compressedDepth" not in message.format:
        return decode_depth(content, source)
    if "rvl" in message.format.lower():
        raise InputError(
            f"{source}: RVL-compressed depth is not supported; republish it as raw or PNG images and record those"
        )
    units = decode_depth(content[_DEPTH_HEADER.size :], source)
    if not message.format.startswith("32FC1"):
        return units
    _, a, b = _DEPTH_HEADER.unpack(content[: _DEPTH_HEADER.size])
    inverse = units.astype(np.float32)  # quantised inverse depth: depth = a / (inverse - b), 0 = no measurement
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(inverse > 0, a / (inverse - b), 0.0)
