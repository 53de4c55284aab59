"""Colour and depth images from files to tensors."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from kornia_rs import io
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from v3d_torch.errors import InputError


def read_colour(path: Path) -> Tensor:
    """Decode a colour image: PNG or JPEG, and whatever else Pillow opens.

    Returns:
        uint8 RGB, shape :math:`(3, H, W)`; a view of rows of pixels (channels last in memory), so that a library that
        wants :math:`(H, W, 3)` gets it without a copy.

    Raises:
        InputError: the file is missing, truncated, not an image, or a 16-bit (depth) image.
    """
    try:
        # Both refuse a truncated file, which kornia_rs.io.read_image and OpenCV fill up with grey.
        if path.suffix.lower() in (".jpg", ".jpeg"):
            pixels = io.read_image_jpegturbo(str(path))
        else:
            pixels = io.read_image_png_u8(str(path), "rgb")
    except Exception:  # kornia_rs raises bare Exception for every cause: Pillow reads the rarer kinds or says why not
        pixels = _uncommon_colour(path, path)
    return torch.from_numpy(pixels).permute(2, 0, 1)


def read_depth(path: Path, depth_scale: float) -> Tensor:
    """Decode a depth image with 16 bits a pixel.

    Args:
        path: PNG, or whatever else with 16 bits Pillow opens.
        depth_scale: units per metre.

    Returns:
        Metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.

    Raises:
        InputError: the file is missing, truncated, not an image, or has not 16 bits.
    """
    try:
        units = io.read_image_png_u16(str(path), "mono")[..., 0]
    except Exception:
        units = _uncommon_depth(path, path)
    return metres(units, depth_scale)


def decode_colour(content: bytes, source: object) -> Tensor:
    """As `read_colour`, from the bytes of a file that ``source`` holds, for messages."""
    try:
        pixels = io.decode_image_jpegturbo(content, "rgb")
    except Exception:  # as above; a PNG ends here
        pixels = _uncommon_colour(BytesIO(content), source)
    return torch.from_numpy(pixels).permute(2, 0, 1)


def decode_depth(content: bytes, source: object) -> NDArray[np.generic]:
    """Units of depth, shape (H, W), from the bytes of a file with 16 bits a pixel, raising as `read_depth`."""
    return _uncommon_depth(BytesIO(content), source)


def metres(units: NDArray[np.generic], depth_scale: float) -> Tensor:
    """Units of depth (H, W), of which there are ``depth_scale`` in a metre, as `RGBDFrame` holds depth."""
    return torch.from_numpy(units.astype(np.float32)).div_(depth_scale).unsqueeze(0)


def is_depth(path: Path) -> bool:
    """Whether a file is a single-channel image of more than 8 bits; reads its header only."""
    try:
        with Image.open(path) as image:
            return image.mode.startswith("I")
    except OSError:
        return False


def _uncommon_colour(file: Path | BytesIO, source: object) -> NDArray[np.uint8]:
    with _open(file, source) as image:
        if image.mode.startswith("I"):
            raise InputError(f"{source}: is a 16-bit depth image where colour belongs; are colour and depth swapped?")
        return np.array(image.convert("RGB"))


def _uncommon_depth(file: Path | BytesIO, source: object) -> NDArray[np.generic]:
    with _open(file, source) as image:
        if image.mode.startswith("I"):
            return np.array(image)
        if image.mode in ("L", "1", "P"):
            raise InputError(f"{source}: is 8-bit, a depth image has 16 bits; export the depth again, unscaled")
        raise InputError(f"{source}: is a colour image where depth belongs; are colour and depth swapped?")


def _open(file: Path | BytesIO, source: object) -> Image.Image:
    """The whole image, decoded."""
    try:
        image = Image.open(file)
        image.load()
    except FileNotFoundError as error:
        raise InputError(f"{source}: is listed but not there; copy the sequence again, whole") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{source}: is truncated or no image; copy or download it again") from error
    return image
