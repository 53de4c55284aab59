"""Decoder of the PNG images of RGB-D cameras.

During a run it is a kernel, which releases the GIL, so that the next frame is read while others are tracked.
"""

from __future__ import annotations

import struct
from typing import NamedTuple
from zlib import crc32

import deflate
import numpy as np
from kornia_rs import io
from numpy.typing import NDArray

from v3d_torch.io.image_file import PNG_SIGNATURE
from v3d_torch.kernels import png_filters as kernels
from v3d_torch.kernels.compiler import compiled_by

_HEADER = struct.Struct(">2I5B")
"""Width, height, bits of a value, colour type, methods of compression and filtering, interlacing."""

Pixels = NDArray[np.uint8 | np.uint16]


class _Layout(NamedTuple):
    """Channels of an image, and type of their values."""

    channels: int
    dtype: type[np.uint8] | type[np.uint16]


_LAYOUTS = {(8, 0): _Layout(1, np.uint8), (8, 2): _Layout(3, np.uint8), (16, 0): _Layout(1, np.uint16)}
"""Supported layouts, by the bits of a value and the colour type."""


class _Chunks(NamedTuple):
    """Header of a PNG image, and its compressed pixels."""

    width: int
    height: int
    layout: _Layout
    compressed: bytes


def _decode_png_compiled(content: bytes, max_pixels: int) -> Pixels:
    width, height, (channels, dtype), compressed = _read_chunks(content, max_pixels)
    pixel_bytes = channels * np.dtype(dtype).itemsize
    row_bytes = 1 + width * pixel_bytes  # the number of a filter, and the pixels
    try:
        filtered = deflate.zlib_decompress(compressed, height * row_bytes)
    except deflate.DeflateError as error:
        raise ValueError(str(error)) from error
    if len(filtered) < height * row_bytes:
        raise ValueError("the image has too few pixels")
    rows = np.frombuffer(filtered, np.uint8).reshape(height, row_bytes)
    pixels = np.empty((height, width * pixel_bytes), np.uint8)
    if not kernels.undo_filters(rows, pixel_bytes, pixels):
        raise ValueError("a row has an unknown filter")
    values: Pixels = pixels.view(np.dtype(dtype).newbyteorder(">")).astype(dtype, copy=False)
    return values.reshape(height, width, channels)


@compiled_by(_decode_png_compiled, on_demand=False)  # a sequence is opened before its run begins
def decode_png(content: bytes, max_pixels: int) -> Pixels:
    """Decode a PNG image with one or three channels of 8 bits, or one channel of 16 bits.

    Source: PNG specification (W3C, third edition).

    Args:
        content: Bytes of the image file.
        max_pixels: Maximum number of pixels.

    Returns:
        Image, uint8 or uint16, shape (H, W, C).

    Raises:
        ValueError: If the image is truncated or damaged, has too many pixels, or has other channels, a palette or
            interlaced rows.
    """
    width, height, (channels, dtype), _ = _read_chunks(content, max_pixels)
    decode = io.decode_image_png_u8 if dtype is np.uint8 else io.decode_image_png_u16
    try:
        return np.asarray(decode(content, (height, width), "rgb" if channels == 3 else "mono"))
    except Exception as error:  # kornia_rs raises bare Exception for every cause
        raise ValueError(str(error)) from error


def _read_chunks(content: bytes, max_pixels: int) -> _Chunks:
    """Read the chunks of an image, and check their checksums.

    Raises:
        ValueError: See `decode_png`.
    """
    width, height, layout, compressed = 0, 0, None, []
    start = len(PNG_SIGNATURE)
    while start + 12 <= len(content):  # length and kind, data, checksum
        kind, end = content[start + 4 : start + 8], start + 8 + int.from_bytes(content[start : start + 4])
        if crc32(memoryview(content)[start + 4 : end]) != int.from_bytes(content[end : end + 4]):
            raise ValueError(f"the checksum of the chunk {kind!r} is wrong")
        data = content[start + 8 : end]
        if kind == b"IHDR" and len(data) == _HEADER.size:
            width, height, bits, colour_type, _, _, interlacing = _HEADER.unpack(data)
            layout = _LAYOUTS.get((bits, colour_type))
            if layout is None or interlacing or not 0 < width * height <= max_pixels:
                raise ValueError("the kind or size of the image is not supported")
        elif kind == b"IDAT":
            compressed.append(data)
        elif kind == b"IEND" and layout is not None:
            return _Chunks(width, height, layout, b"".join(compressed))
        start = end + 4
    raise ValueError("the image is truncated")
