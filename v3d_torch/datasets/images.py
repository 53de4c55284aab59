"""Colour and depth images from files to tensors."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia_rs import io
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from v3d_torch.errors import InputError

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP")
"""What Pillow is let to try: some of its other formats start programs."""

_MAX_PIXELS = 1 << 26
"""Most pixels of an image: ten times those of any such camera. A file of a megabyte may claim gigabytes."""

SATURATED = np.iinfo(np.uint16).max
"""Units of depth that no camera measures; some write it for no measurement."""


def read_colour(path: Path) -> Tensor:
    """Decode a colour image: PNG or JPEG, and rarer formats by Pillow.

    Returns:
        uint8 RGB, shape :math:`(3, H, W)`; a view of rows of pixels (channels last in memory), so that a library that
        wants :math:`(H, W, 3)` gets it without a copy.

    Raises:
        InputError: the file is missing, truncated, not an image, too large, or a 16-bit (depth) image.
    """
    image_size(path)
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
        path: PNG, or a rarer format with 16 bits by Pillow.
        depth_scale: units per metre.

    Returns:
        Metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.

    Raises:
        InputError: the file is missing, truncated, not an image, too large, or has not 16 bits.
    """
    image_size(path)
    try:
        units = io.read_image_png_u16(str(path), "mono")[..., 0]
    except Exception:
        units = _uncommon_depth(path, path)
    return metres(units, depth_scale)


def decode_colour(content: bytes, source: object) -> Tensor:
    """As `read_colour`, from the bytes of a file that ``source`` holds, for messages."""
    _header(BytesIO(content), source)
    try:
        pixels = io.decode_image_jpegturbo(content, "rgb")
    except Exception:  # as above; a PNG ends here
        pixels = _uncommon_colour(BytesIO(content), source)
    return torch.from_numpy(pixels).permute(2, 0, 1)


def decode_depth(content: bytes, source: object) -> NDArray[np.generic]:
    """Units of depth, shape (H, W), from the bytes of a file with 16 bits a pixel, raising as `read_depth`."""
    return _uncommon_depth(BytesIO(content), source)


def metres(units: NDArray[Any], depth_scale: float) -> Tensor:
    """Units of depth (H, W), of which there are ``depth_scale`` in a metre, as `RGBDFrame` holds depth."""
    nothing = torch.from_numpy((units < 0) | (units >= SATURATED))
    return torch.from_numpy(units.astype(np.float32)).div_(depth_scale).masked_fill_(nothing, 0.0).unsqueeze(0)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, from its header.

    Raises:
        InputError: the file is missing, no image, or too large to be one of a camera.
    """
    with _header(path, path) as image:
        return image.size


def is_depth(path: Path) -> bool:
    """Whether a file is a single-channel image of more than 8 bits; reads its header only."""
    try:
        with _header(path, path) as image:
            return image.mode.startswith("I")
    except InputError:
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
        if image.mode == "F":
            raise InputError(f"{source}: has floating-point numbers; export the depth again, as PNG of 16 bits")
        if image.mode in ("L", "1", "P"):
            raise InputError(f"{source}: is 8-bit, a depth image has 16 bits; export the depth again, unscaled")
        raise InputError(f"{source}: is a colour image where depth belongs; are colour and depth swapped?")


def _open(file: Path | BytesIO, source: object) -> Image.Image:
    """The whole image, decoded."""
    image = _header(file, source)
    try:
        image.load()
    except Exception as error:  # a decoder that meets nonsense raises whatever that leads to
        image.close()
        raise InputError(f"{source}: is truncated or broken; copy or download it again") from error
    return image


def _header(file: Path | BytesIO, source: object) -> Image.Image:
    """The image, of which only the header has been read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(file, formats=_FORMATS)
    except FileNotFoundError as error:
        raise InputError(f"{source}: is listed but not there; copy the sequence again, whole") from error
    except UnidentifiedImageError as error:
        raise InputError(f"{source}: is no image, or none of PNG, JPEG or TIFF; copy or export it again") from error
    except Image.DecompressionBombError as error:
        raise _too_large(source) from error
    except Exception as error:  # of the file system, or of a decoder that meets nonsense
        if isinstance(error, OSError) and error.errno is not None:
            raise InputError(f"{source}: cannot be read ({error.strerror}); check who may read it") from error
        raise InputError(f"{source}: is truncated or broken; copy or download it again") from error
    if image.width * image.height > _MAX_PIXELS:
        image.close()
        raise _too_large(source)
    return image


def _too_large(source: object) -> InputError:
    return InputError(f"{source}: claims more than {_MAX_PIXELS >> 20} million pixels; copy or export it again")
