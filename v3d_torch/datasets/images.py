"""Decoding of colour images, and of 16-bit and floating-point images for depth."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from kornia_rs import io
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from v3d_torch.errors import InputError

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP")
"""Formats that Pillow is allowed to open: some of its other decoders start external programs."""

MAX_PIXELS = 1 << 26
"""Maximum number of pixels of an image, far more than those of any RGB-D camera. The header of a small file can state
an image that would fill the memory."""


def read_colour(path: Path) -> Tensor:
    """Read a colour image. PNG and JPEG are decoded by kornia_rs, other formats by Pillow.

    Returns:
        RGB image, uint8, shape :math:`(3, H, W)`. The memory is channels-last, so that :math:`(H, W, 3)` is available
        without a copy.

    Raises:
        InputError: If the file is missing, truncated, not an image, too large, or a 16-bit (depth) image.
    """
    image_size(path)
    try:
        # These two decoders reject truncated files; kornia_rs.io.read_image and OpenCV fill them up with grey.
        if path.suffix.lower() in (".jpg", ".jpeg"):
            pixels = io.read_image_jpegturbo(str(path))
        else:
            pixels = io.read_image_png_u8(str(path), "rgb")
    except Exception:  # kornia_rs raises bare Exception for every cause: Pillow decodes the image or names the cause
        pixels = _decode_colour_with_pillow(path, path)
    return torch.from_numpy(pixels).permute(2, 0, 1)


def read_depth_image(path: Path) -> NDArray[np.generic]:
    """Read a depth image. 16-bit PNG is decoded by kornia_rs, other formats by Pillow.

    Args:
        path: Path of an image with 16 or 32 bits per pixel.

    Returns:
        Whole numbers in units of the file, or metres in floating point, shape (H, W).

    Raises:
        InputError: If the file is missing, truncated, not an image, too large, or not a depth image.
    """
    image_size(path)
    try:
        return io.read_image_png_u16(str(path), "mono")[..., 0]
    except Exception:  # kornia_rs raises bare Exception for every cause: Pillow decodes the image or names the cause
        return _decode_depth_with_pillow(path, path)


def decode_colour(content: bytes, source: object) -> Tensor:
    """Decode a colour image from the bytes of an image file, like `read_colour`.

    Args:
        content: Bytes of the image file.
        source: Origin of the bytes, for messages.

    Returns:
        RGB image, uint8, shape :math:`(3, H, W)`.

    Raises:
        InputError: See `read_colour`.
    """
    _read_header(BytesIO(content), source)
    try:
        pixels = io.decode_image_jpegturbo(content, "rgb")
    except Exception:  # every format but JPEG
        pixels = _decode_colour_with_pillow(BytesIO(content), source)
    return torch.from_numpy(pixels).permute(2, 0, 1)


def decode_depth(content: bytes, source: object) -> NDArray[np.generic]:
    """Decode a depth image from the bytes of an image file, like `read_depth_image`.

    Args:
        content: Bytes of the image file.
        source: Origin of the bytes, for messages.

    Returns:
        Whole numbers in units of the file, or metres in floating point, shape (H, W).

    Raises:
        InputError: See `read_depth_image`.
    """
    return _decode_depth_with_pillow(BytesIO(content), source)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, read from its header.

    Raises:
        InputError: If the file is missing, not an image, or too large.
    """
    with _read_header(path, path) as image:
        return image.size


def is_depth_image(path: Path) -> bool:
    """Check whether a file is a single-channel image of more than 8 bits. Only the header is read."""
    try:
        with _read_header(path, path) as image:
            return _is_depth_mode(image.mode)
    except InputError:
        return False


def _is_depth_mode(mode: str) -> bool:
    """Check a mode of Pillow: I for whole numbers of 16 or 32 bits, F for 32-bit floating point."""
    return mode.startswith("I") or mode == "F"


def _decode_colour_with_pillow(file: Path | BytesIO, source: object) -> NDArray[np.uint8]:
    with _decode(file, source) as image:
        if _is_depth_mode(image.mode):
            kind = "floating-point" if image.mode == "F" else "16-bit"
            raise InputError(
                f"{source}: is a {kind} depth image, expected a colour image; check that colour and depth are not"
                " swapped"
            )
        return np.array(image.convert("RGB"))


def _decode_depth_with_pillow(file: Path | BytesIO, source: object) -> NDArray[np.generic]:
    with _decode(file, source) as image:
        if _is_depth_mode(image.mode):
            return np.array(image)
        if image.mode in ("L", "1", "P"):
            raise InputError(f"{source}: is an 8-bit image, depth needs 16 bits; export depth again without rescaling")
        raise InputError(
            f"{source}: is a colour image, expected a depth image; check that colour and depth are not swapped"
        )


def _decode(file: Path | BytesIO, source: object) -> Image.Image:
    """Decode a whole image."""
    image = _read_header(file, source)
    try:
        if image.format == "PNG":  # Pillow ignores the checksum of pixel data unless verify() is called
            image.verify()
            if isinstance(file, BytesIO):
                file.seek(0)
            image = _read_header(file, source)
        image.load()
    except Exception as error:  # on invalid data a decoder can raise any exception
        image.close()
        raise InputError(f"{source}: is truncated or damaged; copy or download it again") from error
    return image


def _read_header(file: Path | BytesIO, source: object) -> Image.Image:
    """Open an image and read its header only."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(file, formats=_FORMATS)
    except FileNotFoundError as error:
        raise InputError(f"{source}: is listed but does not exist; copy the whole sequence again") from error
    except UnidentifiedImageError as error:
        if _is_tiff(file):
            raise InputError(
                f"{source}: is a TIFF image of an unsupported kind; export depth as 16-bit PNG, or as 32-bit"
                " floating-point TIFF in metres"
            ) from error
        raise InputError(f"{source}: is not a PNG, JPEG or TIFF image; copy or export it again") from error
    except Image.DecompressionBombError as error:
        raise too_large_error(source) from error
    except Exception as error:  # an error of the file system, or any exception of a decoder on invalid data
        if isinstance(error, OSError) and error.errno is not None:
            raise InputError(f"{source}: cannot be read ({error.strerror}); check its permissions") from error
        raise InputError(f"{source}: is truncated or damaged; copy or download it again") from error
    if image.width * image.height > MAX_PIXELS:
        image.close()
        raise too_large_error(source)
    return image


def _is_tiff(file: Path | BytesIO) -> bool:
    """Check the first bytes of a file."""
    content = file.getvalue() if isinstance(file, BytesIO) else file.read_bytes()
    return content.startswith((b"II*\0", b"MM\0*"))


def too_large_error(source: object) -> InputError:
    """Return the error for an image whose header claims more than `MAX_PIXELS`."""
    return InputError(
        f"{source}: has more than {MAX_PIXELS >> 20} million pixels according to its header; copy or export it again"
    )
