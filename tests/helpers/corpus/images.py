"""Damaged image files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from functools import cache
from io import BytesIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from helpers.corpus.base import HEIGHT, STAMPS, WIDTH, camera_position, colour, depth, png
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    Workspace,
    all_of,
    edit,
    fails_after_run,
    fails_at_frame,
    first_half,
    write,
)

RGB = [f"rgb/{stamp}.png" for stamp in STAMPS]
DEPTH = [f"depth/{stamp}.png" for stamp in STAMPS]


def every(files: list[str], content: Callable[[int], bytes]) -> Damage:
    """Rewrite each of these files, by its index."""

    def make(place: Workspace) -> None:
        for i, file in enumerate(files):
            write(file, content(i))(place)

    return make


def saved(image: NDArray[np.generic], form: str, **settings: object) -> bytes:
    """Encode an image with Pillow."""
    file = BytesIO()
    Image.fromarray(image).save(file, form, **settings)
    return file.getvalue()


def deep_colour(frame: int) -> bytes:
    """Colour image with 16 bits per channel, of which the low bytes are random."""
    low = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3))
    return png((colour(*camera_position(frame)).astype(np.uint16) << 8) + low.astype(np.uint16))


def with_alpha(frame: int) -> bytes:
    """Colour image with an alpha channel that is 0 for half of the pixels."""
    alpha = np.tile(np.array([0, 255], np.uint8), (HEIGHT, WIDTH // 2))
    return png(np.dstack([colour(*camera_position(frame)), alpha]))


def grey(frame: int) -> bytes:
    """Greyscale image."""
    return png(cv2.cvtColor(colour(*camera_position(frame)), cv2.COLOR_BGR2GRAY))


def palette(frame: int) -> bytes:
    """Colour image with a palette."""
    file = BytesIO()
    Image.fromarray(colour(*camera_position(frame))[..., ::-1]).quantize(256).save(file, "png")
    return file.getvalue()


def jpeg(frame: int) -> bytes:
    """Colour image encoded as JPEG."""
    return cv2.imencode(".jpg", colour(*camera_position(frame)), [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()


@cache
def packed_zeros() -> bytes:
    """64 MB of zeros, compressed."""
    packer = zlib.compressobj(9)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(64)) + packer.flush()


def bomb(width: int, height: int, bits: int, kind: int) -> bytes:
    """PNG of zeros, small on disk and large in memory (decompression bomb)."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed_zeros()) + chunk(b"IEND", b"")


def flip_bit(content: bytes) -> bytes:
    """Flip one bit of the pixel data."""
    at = len(content) - 30
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def swap_lists(place: Workspace) -> None:
    """Swap the lists of colour and depth images."""
    colours, depths = (place.folder / name for name in ("rgb.txt", "depth.txt"))
    text = colours.read_text()
    colours.write_text(depths.read_text())
    depths.write_text(text)


def arrays(image: NDArray[np.generic]) -> Damage:
    """Replace the depth images by files of NumPy."""

    def make(place: Workspace) -> None:
        for file in DEPTH:
            (place.folder / file).unlink()
            np.save(place.folder / file.replace(".png", ".npy"), image, allow_pickle=True)
        path = place.folder / "depth.txt"
        path.write_text(path.read_text().replace(".png", ".npy"))

    return make


METRES = np.full((HEIGHT, WIDTH), 1.0, np.float32)
SMALL = cv2.resize(colour(*camera_position(0)), (WIDTH // 2, HEIGHT // 2))
PAGE = "<!DOCTYPE html>\n<html><body>404 Not Found</body></html>\n"

CASES = [
    Case(
        "first colour image truncated",
        edit(RGB[0], first_half),
        Fails("{seq}/rgb/1305031102.000000.png: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "first depth image truncated",
        edit(DEPTH[0], first_half),
        Fails("{seq}/depth/1305031102.000000.png: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "colour image truncated",
        edit(RGB[5], first_half),
        fails_at_frame(5, "{seq}/rgb/1305031102.500000.png: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "depth image truncated",
        edit(DEPTH[5], first_half),
        fails_at_frame(5, "{seq}/depth/1305031102.500000.png: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "colour image with a flipped bit",
        edit(RGB[5], flip_bit),
        fails_at_frame(5, "{seq}/rgb/1305031102.500000.png: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "depth image with a flipped bit",
        edit(DEPTH[5], flip_bit),
        fails_at_frame(5, "{seq}/depth/1305031102.500000.png: is truncated or damaged; copy or download it again"),
    ),
    Case(
        "empty colour image",
        write(RGB[5], ""),
        fails_at_frame(5, "{seq}/rgb/1305031102.500000.png: is not a PNG, JPEG or TIFF image; copy or export it again"),
    ),
    Case(
        "empty depth image",
        write(DEPTH[5], ""),
        fails_at_frame(
            5, "{seq}/depth/1305031102.500000.png: is not a PNG, JPEG or TIFF image; copy or export it again"
        ),
    ),
    Case(
        "web page instead of an image",
        write(RGB[2], PAGE),
        fails_at_frame(2, "{seq}/rgb/1305031102.200000.png: is not a PNG, JPEG or TIFF image; copy or export it again"),
    ),
    Case(
        "colour and depth swapped in the lists",
        swap_lists,
        Fails(
            "{seq}/depth/1305031102.000000.png: is a 16-bit depth image, expected a colour image; check that"
            " colour and depth are not swapped"
        ),
    ),
    Case(
        "depth image instead of a colour image",
        write(RGB[4], png(depth())),
        fails_at_frame(
            4,
            "{seq}/rgb/1305031102.400000.png: is a 16-bit depth image, expected a colour image; check that"
            " colour and depth are not swapped",
        ),
    ),
    Case(
        "colour image instead of a depth image",
        write(DEPTH[4], png(colour(0))),
        fails_at_frame(
            4,
            "{seq}/depth/1305031102.400000.png: is a colour image, expected a depth image; check that colour and"
            " depth are not swapped",
        ),
    ),
    Case(
        "8-bit depth",
        every(DEPTH, lambda i: png((depth() >> 8).astype(np.uint8))),
        Fails(
            "{seq}/depth/1305031102.000000.png: is an 8-bit image, depth needs 16 bits; export depth again"
            " without rescaling"
        ),
    ),
    Case(
        "8-bit depth in one frame",
        write(DEPTH[4], png((depth() >> 8).astype(np.uint8))),
        fails_at_frame(
            4,
            "{seq}/depth/1305031102.400000.png: is an 8-bit image, depth needs 16 bits; export depth again"
            " without rescaling",
        ),
    ),
    Case(
        "colour-mapped depth",
        every(DEPTH, lambda i: png(cv2.applyColorMap((depth() >> 8).astype(np.uint8), 2))),
        Fails(
            "{seq}/depth/1305031102.000000.png: is a colour image, expected a depth image; check that colour"
            " and depth are not swapped"
        ),
    ),
    Case(
        "16-bit depth with three channels",
        every(DEPTH, lambda i: png(np.dstack(3 * [depth()]))),
        Fails(
            "{seq}/depth/1305031102.000000.png: is a colour image, expected a depth image; check that colour"
            " and depth are not swapped"
        ),
    ),
    Case("16-bit colour", every(RGB, deep_colour), Succeeds()),
    Case("colour with an alpha channel", every(RGB, with_alpha), Succeeds()),
    Case("greyscale images", every(RGB, grey), Succeeds()),
    Case("images with a palette", every(RGB, palette), Succeeds()),
    Case("JPEG named PNG", every(RGB, jpeg), Succeeds()),
    Case(
        "depth as JPEG",
        every(DEPTH, jpeg),
        Fails(
            "{seq}/depth/1305031102.000000.png: is a colour image, expected a depth image; check that colour"
            " and depth are not swapped"
        ),
    ),
    Case(
        "floating-point depth with NaN",
        every(DEPTH, lambda i: saved(np.full((HEIGHT, WIDTH), np.nan, np.float32), "tiff")),
        fails_after_run(
            "seq: the camera was not found in any of the 8 frames, the depth images are empty; record or export them"
            " again"
        ),
    ),
    Case("floating-point depth in metres", every(DEPTH, lambda i: saved(METRES, "tiff")), Succeeds()),
    Case(
        "floating-point depth in millimetres",
        every(DEPTH, lambda i: saved(1000 * METRES, "tiff")),
        Fails(
            "{seq}: the median depth of the first frame is 1e+03 m, although depth in floating point is in metres;"
            " export it in metres"
        ),
    ),
    Case(
        "floating-point depth in one frame only",
        write(DEPTH[4], saved(METRES, "tiff")),
        Succeeds(),
    ),
    Case("depth as NumPy arrays in metres", arrays(METRES), Succeeds()),
    Case("depth as NumPy arrays in units", arrays(depth()), Succeeds()),
    Case(
        "depth as truncated NumPy arrays",
        all_of(arrays(METRES), edit(DEPTH[5].replace(".png", ".npy"), first_half)),
        fails_at_frame(
            5, "{seq}/depth/1305031102.500000.npy: is truncated or not a NumPy array; copy or export it again"
        ),
    ),
    Case(
        "depth as NumPy arrays of objects",
        arrays(np.array([[None]])),
        Fails("{seq}/depth/1305031102.000000.npy: is truncated or not a NumPy array; copy or export it again"),
    ),
    Case(
        "colour and depth swapped in the lists, depth in floating point",
        all_of(every(DEPTH, lambda i: saved(METRES, "tiff")), swap_lists),
        Fails(
            "{seq}/depth/1305031102.000000.png: is a floating-point depth image, expected a colour image; check that"
            " colour and depth are not swapped"
        ),
    ),
    Case(
        "depth as OpenEXR",
        every(DEPTH, lambda i: b"v/1\x01\x02\0\0\0channels\0chlist\0" + bytes(300)),
        Fails("{seq}/depth/1305031102.000000.png: is not a PNG, JPEG or TIFF image; copy or export it again"),
    ),
    Case(
        "depth as a NumPy array",
        every(DEPTH, lambda i: b"\x93NUMPY\x01\0v\0{'descr': '<f4', 'fortran_order': False}" + bytes(300)),
        Fails("{seq}/depth/1305031102.000000.png: is not a PNG, JPEG or TIFF image; copy or export it again"),
    ),
    Case(
        "32-bit depth, negative for missing depth",
        every(DEPTH, lambda i: saved(np.where(np.arange(WIDTH) % 8, depth(), -1).astype(np.int32), "tiff")),
        Succeeds(),
    ),
    Case(
        "colour smaller than depth",
        every(RGB, lambda i: png(cv2.resize(colour(*camera_position(i)), (WIDTH // 2, HEIGHT // 2)))),
        Fails(
            "{seq}/depth/1305031102.000000.png: has 128x96 pixels, but its colour image has 64x48; export depth"
            " that is registered to the colour image"
        ),
    ),
    Case(
        "depth smaller than colour",
        every(DEPTH, lambda i: png(depth()[::2, ::2])),
        Fails(
            "{seq}/depth/1305031102.000000.png: has 64x48 pixels, but its colour image has 128x96; export depth"
            " that is registered to the colour image"
        ),
    ),
    Case(
        "both images smaller than the camera",
        all_of(every(RGB, lambda i: png(SMALL)), every(DEPTH, lambda i: png(depth()[::2, ::2]))),
        Fails(
            "{seq}/rgb/1305031102.000000.png: has 64x48 pixels, but the camera has 128x96; pass the camera of"
            " these images with --camera"
        ),
    ),
    Case(
        "one colour image of another size",
        write(RGB[3], png(SMALL)),
        fails_at_frame(
            3,
            "{seq}/depth/1305031102.300000.png: has 128x96 pixels, but its colour image has 64x48; export depth"
            " that is registered to the colour image",
        ),
    ),
    Case(
        "one depth image of another size",
        write(DEPTH[3], png(depth()[::2, ::2])),
        fails_at_frame(
            3,
            "{seq}/depth/1305031102.300000.png: has 64x48 pixels, but its colour image has 128x96; export depth"
            " that is registered to the colour image",
        ),
    ),
    Case(
        "one rotated depth image",
        write(DEPTH[3], png(depth().T.copy())),
        fails_at_frame(
            3,
            "{seq}/depth/1305031102.300000.png: has 96x128 pixels, but its colour image has 128x96; export depth"
            " that is registered to the colour image",
        ),
    ),
    Case(
        "colour image with a header of 40000 x 40000 pixels",
        write(RGB[3], bomb(40000, 40000, 8, 2)),
        fails_at_frame(
            3,
            "{seq}/rgb/1305031102.300000.png: has more than 64 million pixels according to its header; copy or"
            " export it again",
        ),
    ),
    Case(
        "depth image with a header of 40000 x 40000 pixels",
        write(DEPTH[3], bomb(40000, 40000, 16, 0)),
        fails_at_frame(
            3,
            "{seq}/depth/1305031102.300000.png: has more than 64 million pixels according to its header; copy or"
            " export it again",
        ),
    ),
    Case(
        "first image with a header of 40000 x 40000 pixels",
        write(RGB[0], bomb(40000, 40000, 8, 2)),
        Fails(
            "{seq}/rgb/1305031102.000000.png: has more than 64 million pixels according to its header; copy or"
            " export it again"
        ),
    ),
]
