"""Decoding of colour images, and of 16-bit and floating-point images for depth."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from v3d_torch.datasets.png import Pixels, decode_png
from v3d_torch.errors import InputError
from v3d_torch.io.image_file import MAX_PIXELS, PNG_SIGNATURE

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP")
"""Formats that Pillow is allowed to open: some of its other decoders start external programs."""

_MAX_BYTES = 8 * MAX_PIXELS
"""Number of bytes that are read of a file at most: 16-bit RGB images of `MAX_PIXELS` without compression have fewer."""

_JPEG_SIGNATURE = b"\xff\xd8\xff"
"""First bytes of a JPEG image."""

_TIFF_SIGNATURES = (b"II*\0", b"MM\0*")
"""First bytes of a TIFF image, for both byte orders."""


def read_colour(path: Path) -> Tensor:
    """Read a colour image from a file, see `decode_colour`.

    Raises:
        InputError: If the file is missing, truncated, not an image, too large, or a 16-bit (depth) image.
    """
    return decode_colour(_read_file(path), path)


def read_depth_image(path: Path) -> NDArray[np.generic]:
    """Read a depth image from a file, see `decode_depth`.

    Raises:
        InputError: If the file is missing, truncated, not an image, too large, or not a depth image.
    """
    return decode_depth(_read_file(path), path)


def decode_colour(content: bytes, source: object) -> Tensor:
    """Decode a colour image. PNG and JPEG are decoded without the GIL, other formats by Pillow.

    Args:
        content: Bytes of the image file.
        source: Origin of the bytes, for messages.

    Returns:
        RGB image, uint8, shape :math:`(3, H, W)`. The memory is channels-last, so that :math:`(H, W, 3)` is available
        without a copy.

    Raises:
        InputError: If the image is truncated, not an image, too large, or a 16-bit (depth) image.
    """
    pixels = _decode_common(content)
    if pixels is None or pixels.shape[2] != 3:
        pixels = _decode_colour_with_pillow(content, source)
    return torch.from_numpy(pixels).permute(2, 0, 1)


def decode_depth(content: bytes, source: object) -> NDArray[np.generic]:
    """Decode a depth image. 16-bit PNG is decoded without the GIL, PGM by OpenCV, other formats by Pillow.

    Args:
        content: Bytes of the file of an image with 16 or 32 bits per pixel.
        source: Origin of the bytes, for messages.

    Returns:
        Whole numbers in units of the file, or metres in floating point, shape (H, W).

    Raises:
        InputError: If the image is truncated, not an image, too large, or not a depth image.
    """
    pixels = _decode_common(content)
    if pixels is None or pixels.dtype != np.uint16:
        return _decode_other_depth(content, source)
    return pixels[..., 0]


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


def _read_file(path: Path) -> bytes:
    """Bytes of a file, the first ones if it is too large for an image."""
    with _file_errors(path), path.open("rb") as file:
        return file.read(min(os.fstat(file.fileno()).st_size, _MAX_BYTES))


def _decode_common(content: bytes) -> Pixels | None:
    """Decode a PNG or JPEG image, shape (H, W, C).

    Returns:
        None for an image of another kind, or that is damaged or too large: Pillow decodes it or names the cause.
    """
    try:
        if content.startswith(PNG_SIGNATURE):
            return decode_png(content, MAX_PIXELS)
        if content.startswith(_JPEG_SIGNATURE):
            height, width, colours, _ = simplejpeg.decode_jpeg_header(content)
            if height * width <= MAX_PIXELS and colours not in ("CMYK", "YCCK"):  # Pillow converts inks better
                return simplejpeg.decode_jpeg(content, "RGB")
    except ValueError:
        pass
    return None


def _is_depth_mode(mode: str) -> bool:
    """Check a mode of Pillow: I for whole numbers of 16 or 32 bits, F for 32-bit floating point."""
    return mode.startswith("I") or mode == "F"


def _decode_colour_with_pillow(content: bytes, source: object) -> NDArray[np.uint8]:
    with _decode(content, source) as image:
        if _is_depth_mode(image.mode):
            kind = "floating-point" if image.mode == "F" else "16-bit"
            raise InputError(
                f"{source}: is a {kind} depth image, expected a colour image; check that colour and depth are not"
                " swapped"
            )
        return np.array(image.convert("RGB"))


def _decode_other_depth(content: bytes, source: object) -> NDArray[np.generic]:
    with _decode(content, source) as image:
        if image.format == "PPM" and image.mode == "I":
            return _decode_pgm(content, source)
        if _is_depth_mode(image.mode):
            return np.array(image)
        if image.mode in ("L", "1", "P"):
            raise InputError(f"{source}: is an 8-bit image, depth needs 16 bits; export depth again without rescaling")
        raise InputError(
            f"{source}: is a colour image, expected a depth image; check that colour and depth are not swapped"
        )


def _decode_pgm(content: bytes, source: object) -> NDArray[np.generic]:
    """Decode a 16-bit PGM image by OpenCV: Pillow scales the values so that the maximum in the header becomes 65535."""
    # A newline is needed after the last number of a text.
    pixels: NDArray[np.generic] | None = cv2.imdecode(np.frombuffer(content + b"\n", np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise _damaged_error(source)
    return pixels


def _decode(content: bytes, source: object) -> Image.Image:
    """Decode a whole image."""
    image = _read_header(BytesIO(content), source)
    try:
        if image.format == "PNG":  # Pillow ignores the checksum of pixel data unless verify() is called
            image.verify()
            image = _read_header(BytesIO(content), source)
        image.load()
    except Exception as error:  # on invalid data a decoder can raise any exception
        image.close()
        raise _damaged_error(source) from error
    return image


def _read_header(file: Path | BytesIO, source: object) -> Image.Image:
    """Open an image and read its header only."""
    try:
        with _file_errors(source), warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(file, formats=_FORMATS)
    except InputError:
        raise
    except UnidentifiedImageError as error:
        if _is_tiff(file):
            raise InputError(
                f"{source}: is a TIFF image of an unsupported kind; export depth as 16-bit PNG, or as 32-bit"
                " floating-point TIFF in metres"
            ) from error
        raise InputError(f"{source}: is not a PNG, JPEG or TIFF image; copy or export it again") from error
    except Image.DecompressionBombError as error:
        raise too_large_error(source) from error
    except Exception as error:  # on invalid data a decoder can raise any exception
        raise _damaged_error(source) from error
    if image.width * image.height > MAX_PIXELS:
        image.close()
        raise too_large_error(source)
    return image


@contextmanager
def _file_errors(source: object) -> Iterator[None]:
    """Turn errors of the file system into an InputError."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{source}: is listed but does not exist; copy the whole sequence again") from error
    except OSError as error:
        if error.errno is None:  # raised by a decoder
            raise
        raise InputError(f"{source}: cannot be read ({error.strerror}); check its permissions") from error


def _is_tiff(file: Path | BytesIO) -> bool:
    """Check the first bytes of a file."""
    if isinstance(file, BytesIO):
        return file.getvalue().startswith(_TIFF_SIGNATURES)
    with file.open("rb") as opened:
        return opened.read(len(_TIFF_SIGNATURES[0])) in _TIFF_SIGNATURES


def too_large_error(source: object) -> InputError:
    """Return the error for an image whose header claims more than `MAX_PIXELS`."""
    return InputError(
        f"{source}: has more than {MAX_PIXELS >> 20} million pixels according to its header; copy or export it again"
    )


def _damaged_error(source: object) -> InputError:
    return InputError(f"{source}: is truncated or damaged; copy or download it again")
