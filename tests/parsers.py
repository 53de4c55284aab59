"""The doors at which bytes come in, for tests that push any bytes through them: parsed, or refused as `V3DError`."""

from __future__ import annotations

import struct
import tarfile
import tempfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from bags import DEPTH, INFO, RGB, Kind, Messages
from PIL import Image

from v3d_torch.config_file import load_config
from v3d_torch.datasets import openloris
from v3d_torch.datasets.bag import BagSequence
from v3d_torch.datasets.bag_images import colour_from, depth_from
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.datasets.encodings import COLOURS
from v3d_torch.datasets.images import decode_colour, decode_depth, read_colour, read_depth
from v3d_torch.datasets.lists import read_associations, read_image_list
from v3d_torch.datasets.matrices import read_matrix, read_poses
from v3d_torch.errors import V3DError
from v3d_torch.extract import extract_tar
from v3d_torch.trajectory import read_trajectory

Parser = Callable[[bytes, Path], object]
"""Parses bytes, in a folder for files that it needs."""


def from_file(name: str, read: Callable[[Path], object]) -> Parser:
    """A parser that reads a file of this name."""

    def parse(content: bytes, folder: Path) -> object:
        path = folder / name
        path.write_bytes(content)
        return read(path)

    return parse


def as_overrides(content: bytes, folder: Path) -> object:
    """A line for each ``--set``."""
    return load_config(None, content.decode("utf-8", "surrogateescape").splitlines())


def message(content: bytes) -> SimpleNamespace:
    """A ROS image whose first bytes say its encoding and its size, and the rest of which are its pixels."""
    head = content[:8].ljust(8, b"\0")
    encodings = [*COLOURS, "16UC1", "mono16", "32FC1", "", "8UC4"]
    return SimpleNamespace(
        encoding=encodings[head[0] % len(encodings)],
        is_bigendian=head[1] & 1,
        width=int.from_bytes(head[2:4], "little"),
        height=int.from_bytes(head[4:6], "little"),
        step=int.from_bytes(head[6:8], "little"),
        data=np.frombuffer(content[8:], np.uint8),
    )


def compressed(content: bytes) -> SimpleNamespace:
    forms = ["jpeg", "png", "16UC1; compressedDepth", "32FC1; compressedDepth", "16UC1; compressedDepth rvl", ""]
    form = forms[content[0] % len(forms)] if content else ""
    return SimpleNamespace(format=form, data=np.frombuffer(content[1:], np.uint8))


def frames_of(bag: Path) -> object:
    """Every frame of a bag, of which the index or a message may be broken."""
    return list(BagSequence(bag))


def unpack(path: Path) -> object:
    folder = path.with_name("unpacked")
    return extract_tar(path, folder, max_bytes=1 << 20)


PARSERS: dict[str, Parser] = {
    "image list": from_file("rgb.txt", read_image_list),
    "associations": from_file("associations.txt", read_associations),
    "trajectory": from_file("groundtruth.txt", read_trajectory),
    "matrix": from_file("pose.txt", read_matrix),
    "pose": from_file("pose.txt", lambda path: read_poses({0.0: path})),
    "camera.yaml": from_file("camera.yaml", load_camera),
    "K.txt": from_file("K.txt", load_camera),
    "configuration": from_file("config.yaml", load_config),
    "--set": as_overrides,
    "colour file": from_file("image.png", read_colour),
    "JPEG file": from_file("image.jpg", read_colour),
    "depth file": from_file("image.png", lambda path: read_depth(path, 5000.0)),
    "colour in a message": lambda content, folder: decode_colour(content, "topic"),
    "depth in a message": lambda content, folder: decode_depth(content, "topic"),
    "colour message": lambda content, folder: colour_from(message(content), "topic"),
    "depth message": lambda content, folder: depth_from(message(content), 1000.0, "topic"),
    "compressed colour message": lambda content, folder: colour_from(compressed(content), "topic"),
    "compressed depth message": lambda content, folder: depth_from(compressed(content), 1000.0, "topic"),
    "sensors.yaml": from_file("sensors.yaml", openloris._read_camera),
    "trans_matrix.yaml": from_file("trans_matrix.yaml", openloris._read_links),
    "ROS 1 bag": from_file("take.bag", frames_of),
    "ROS 2 bag": from_file("take.db3", frames_of),
    "mcap": from_file("take.mcap", frames_of),
    "archive": from_file("archive.tgz", unpack),
}


def _bag(kind: Kind) -> bytes:
    """A frame of 8x6 pixels."""
    to = Messages(kind)
    matrix = [8.0, 0, 3.5, 0, 8.0, 2.5, 0, 0, 1]
    pixels = np.arange(48, dtype=np.uint16).reshape(6, 8) + 1000
    messages = [
        (INFO, 1.0, to.info(8, 6, matrix, [], [*matrix[:3], 0, *matrix[3:6], 0, *matrix[6:], 0])),
        (RGB, 1.0, to.image(1.0, "mono8", pixels.astype(np.uint8))),
        (DEPTH, 1.0, to.image(1.0, "16UC1", pixels)),
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = to.write(Path(folder) / "take", messages)
        return (path if kind == "bag" else next(path.glob(f"*.{kind}"))).read_bytes()


def _tar(mode: str) -> bytes:
    file = BytesIO()
    with tarfile.open(fileobj=file, mode=mode) as tar:
        for name in ("seq/rgb.txt", "seq/" + 120 * "x", "seq/depth/1.png"):
            info = tarfile.TarInfo(name)
            info.size = 5
            tar.addfile(info, BytesIO(b"12345"))
    return file.getvalue()


def _image(form: str, mode: str) -> bytes:
    file = BytesIO()
    pixels = np.arange(48, dtype=np.uint16 if mode == "I;16" else np.uint8).reshape(6, 8)
    Image.fromarray(pixels).convert(mode if mode != "I;16" else None).save(file, form)
    return file.getvalue()


def _message(encoding: int, pixel: int) -> bytes:
    """An 8x6 image as `message` reads it."""
    return struct.pack("<BBHHH", encoding, 0, 8, 6, 8 * pixel) + bytes(range(48 * pixel))


_LIST = b"# colour\n1305031102.175304 rgb/1305031102.175304.png\n1305031102.2 rgb/a b.png\r\n"
_POSES = b"# stamp tx ty tz qx qy qz qw\n1.5 0.1 -2 3e-1 0 0 0 1\n2.5,1,2,3,0,0,0.7071,0.7071\n"
_POSE = b"1 0 0 0.5\n0 0 -1 2\n0 1 0 -inf\n0 0 0 1\n"
_CAMERA = (
    b"fx: 525.0\nfy: 525\ncx: 319.5\ncy: 239.5\nwidth: 640\nheight: 480\ndepth_scale: 5000\n"
    b"distortion: [0.1, 0, 0, 0, 0]\n"
)
_PNGS = [_image("png", mode) for mode in ("RGB", "L", "P", "1", "RGBA", "I;16")]
_JPEGS = [_image("jpeg", mode) for mode in ("RGB", "L", "CMYK")]
_TIFFS = [_image("tiff", mode) for mode in ("RGB", "I;16", "F")]
_OTHERS = [_image("bmp", "RGB"), _image("ppm", "RGB"), _image("webp", "RGB")]
_RASTERS = [*_PNGS, *_JPEGS, *_TIFFS, *_OTHERS]
_SENSORS = b"""%YAML:1.0
d400_color_optical_frame:
   width: 8
   height: 6
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 8.5, 3.5, 8.5, 2.5 ]
"""
_LINKS = b"""%YAML:1.0
trans_matrix:
   -
      parent_frame: base_link
      child_frame: d400_color_optical_frame
      matrix: !!opencv-matrix
         rows: 4
         cols: 4
         dt: d
         data: [ 0., 0., 1., 0.3, -1., 0., 0., 0.05, 0., -1., 0., 0.4, 0., 0., 0., 1. ]
"""
_YAML = b"seed: 3\nobjects:\n  voting: {distance_threshold: 0.1, baselines: [0.0, .inf]}\n"

SEEDS: dict[str, list[bytes]] = {
    "image list": [_LIST],
    "associations": [b"1.5 rgb/1.png 1.51 depth/1.png\n2 rgb/a 2.png 2.0 depth/a, b.png\n"],
    "trajectory": [_POSES, b"1403636579763555584 0 0 0 0 0 0 1\n"],
    "matrix": [_POSE, b"525 0 319.5\n0 525 239.5\n0 0 1\n"],
    "pose": [_POSE, _POSE.replace(b"-inf", b"1")],
    "camera.yaml": [_CAMERA],
    "K.txt": [b"525 525 319.5 239.5 5000 640 480\n", b"525 0 319.5\n0 525 239.5\n0 0 1\n"],
    "configuration": [_YAML],
    "--set": [b"objects.voting.distance_threshold=0.1\nseed=3\nfeatures={count: 30}\n"],
    "colour file": _RASTERS,
    "JPEG file": _JPEGS,
    "depth file": _RASTERS,
    "colour in a message": _RASTERS,
    "depth in a message": _RASTERS,
    "colour message": [_message(i, COLOURS[encoding][0]) for i, encoding in enumerate(COLOURS)],
    "depth message": [_message(len(COLOURS), 2), _message(len(COLOURS) + 2, 4)],
    "compressed colour message": [b"\0" + image for image in _RASTERS],
    "compressed depth message": [bytes([i]) + struct.pack("<iff", 0, 1.0, 0.0) + _PNGS[-1] for i in (2, 3)]
    + [b"\1" + _PNGS[-1]],
    "sensors.yaml": [_SENSORS],
    "trans_matrix.yaml": [_LINKS],
    "ROS 1 bag": [_bag("bag")],
    "ROS 2 bag": [_bag("db3")],
    "mcap": [_bag("mcap")],
    "archive": [_tar(mode) for mode in ("w", "w:gz", "w:bz2", "w:xz")],
}
"""Bytes that a parser takes, to begin with."""


def outcome(parser: str, content: bytes, folder: Path) -> object | V3DError:
    """What a parser makes of bytes, or how it refuses them.

    Raises:
        AssertionError: the refusal is no sentence.
        Exception: anything else, which is what the tests look for.
    """
    try:
        return PARSERS[parser](content, folder)
    except V3DError as error:
        assert str(error)
        return error
