"""PNG decoder: the pixels that were written, with all filters, and one error for what it does not support."""

from __future__ import annotations

import zlib
from io import BytesIO

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from v3d_torch.datasets.png import decode_png
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS

TWIN = TWINS[f"{decode_png.__module__}.{decode_png.__qualname__}"]

DECODERS = [TWIN.compiled, TWIN.torch] if compiler.ENABLED else [TWIN.torch]

FILTERS = [
    cv2.IMWRITE_PNG_FILTER_NONE,
    cv2.IMWRITE_PNG_FILTER_SUB,
    cv2.IMWRITE_PNG_FILTER_UP,
    cv2.IMWRITE_PNG_FILTER_AVG,
    cv2.IMWRITE_PNG_FILTER_PAETH,
    cv2.IMWRITE_PNG_ALL_FILTERS,
]
"""Filters of OpenCV's encoder; the last one is the best of all for each row."""


def pixels_of(seed: int, kind: str, height: int, width: int) -> NDArray[np.generic]:
    """Random pixels: half of them smooth, so that each filter has neighbours of all orders."""
    random = np.random.default_rng(seed)
    shape, dtype, end = {
        "grey": ((height, width, 1), np.uint8, 256),
        "rgb": ((height, width, 3), np.uint8, 256),
        "depth": ((height, width, 1), np.uint16, 65536),
    }[kind]
    noise = random.integers(0, end, shape)
    smooth = np.cumsum(random.integers(-3, 4, shape), axis=1)
    return np.where(random.random(shape) < 0.5, noise, smooth % end).astype(dtype)


def encode(pixels: NDArray[np.generic], chosen: int) -> bytes:
    ordered = np.ascontiguousarray(pixels[..., ::-1])  # OpenCV writes blue first
    return cv2.imencode(".png", ordered, [cv2.IMWRITE_PNG_FILTER, chosen])[1].tobytes()


@pytest.mark.parametrize("kind", ["grey", "rgb", "depth"])
@pytest.mark.parametrize("chosen", FILTERS)
@settings(max_examples=20)
@given(height=st.integers(1, 20), width=st.integers(1, 20), seed=st.integers(0, 1000))
def test_pixels_of_all_filters_are_those_that_were_written(
    kind: str, chosen: int, height: int, width: int, seed: int
) -> None:
    pixels = pixels_of(seed, kind, height, width)
    content = encode(pixels, chosen)
    for decode in DECODERS:
        found = decode(content, height * width)
        assert found.dtype == pixels.dtype
        assert np.array_equal(found, pixels)


def test_compressed_pixels_can_be_in_several_chunks() -> None:
    """OpenCV begins a new chunk every 8 kB."""
    pixels = pixels_of(0, "depth", 100, 100)
    content = encode(pixels, cv2.IMWRITE_PNG_FILTER_NONE)
    assert content.count(b"IDAT") > 1
    for decode in DECODERS:
        assert np.array_equal(decode(content, pixels.size), pixels)


def saved(image: Image.Image) -> bytes:
    file = BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


COLOUR = Image.fromarray(pixels_of(1, "rgb", 8, 9))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (saved(COLOUR.convert("RGBA")), "not supported"),
        (saved(COLOUR.convert("P")), "not supported"),
        (saved(COLOUR.convert("1")), "not supported"),
        (saved(COLOUR)[:-12], "truncated"),
        (saved(COLOUR)[:-1], "truncated"),
        (saved(COLOUR)[:60], "checksum"),
        (saved(COLOUR)[:8], "truncated"),
        (b"", "truncated"),
    ],
    ids=["alpha", "palette", "1 bit", "no end", "end cut", "pixels cut", "signature only", "empty"],
)
def test_other_images_are_errors(content: bytes, message: str) -> None:
    for decode in DECODERS:
        with pytest.raises(ValueError, match=message):
            decode(content, 1000)


@pytest.mark.parametrize(
    ("compressed", "message"),
    [
        (zlib.compress(b"\0" * 10), "too few pixels|does not have enough data"),
        (zlib.compress(b"\5" * 224), "unknown filter|Unknown filter method 5"),
        (b"abc", "Decompression failed|Corrupt deflate stream"),
    ],
    ids=["too few", "unknown filter", "not compressed"],
)
def test_damaged_pixels_are_an_error(compressed: bytes, message: str) -> None:
    """The checksum is right."""
    content = saved(COLOUR)
    begin = content.index(b"IDAT")
    end = content.index(b"IEND") - 4
    chunk = b"IDAT" + compressed
    damaged = len(compressed).to_bytes(4) + chunk + zlib.crc32(chunk).to_bytes(4)
    for decode in DECODERS:
        with pytest.raises(ValueError, match=message):
            decode(content[: begin - 4] + damaged + content[end:], 1000)


def test_number_of_pixels_is_limited() -> None:
    content = saved(COLOUR)
    for decode in DECODERS:
        assert decode(content, 72).shape == (8, 9, 3)
        with pytest.raises(ValueError, match="size of the image is not supported"):
            decode(content, 71)
