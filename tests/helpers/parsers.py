"""All parsers of input files, for tests with arbitrary bytes: they return a result or raise `V3DError`."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import icl_nuim, openloris
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.datasets.depth_files import read_depth_file
from v3d_torch.datasets.gravity_file import read_gravity_file
from v3d_torch.datasets.images import decode_colour, decode_depth, read_colour
from v3d_torch.datasets.lists import read_associations, read_image_list
from v3d_torch.datasets.matrix_files import read_matrix, read_poses
from v3d_torch.datasets.ros import BagSequence
from v3d_torch.datasets.ros.bag_images import decode_colour_message, decode_depth_message
from v3d_torch.datasets.ros.encodings import COLOUR_ENCODINGS
from v3d_torch.datasets.sensor_info import read_sensor_info
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import V3DError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import depth_to_metres
from v3d_torch.io.extract import extract_tar
from v3d_torch.io.ply import read_ply_points
from v3d_torch.mapping.map_io import load_map
from v3d_torch.occupancy.occupancy_io import load_occupancy
from v3d_torch.runs import metrics_file, stored_run
from v3d_torch.runs.request import read_request
from v3d_torch.types import Trajectory

Parser = Callable[[bytes, Path], object]
"""Parser of bytes, with a folder for temporary files."""


def from_file(name: str, read: Callable[[Path], object]) -> Parser:
    """Make a parser that writes the bytes to a file and reads it."""

    def parse(content: bytes, folder: Path) -> object:
        path = folder / name
        path.write_bytes(content)
        return read(path)

    return parse


def parse_overrides(content: bytes, folder: Path) -> object:
    """Parse each line as the value of an option ``--set``."""
    return load_config(None, content.decode("utf-8", "surrogateescape").splitlines())


def image_message(content: bytes) -> SimpleNamespace:
    """Make a ROS image: the first eight bytes give its encoding and size, the others are its pixels."""
    header = content[:8].ljust(8, b"\0")
    encodings = [*COLOUR_ENCODINGS, "16UC1", "mono16", "32FC1", "", "8UC4"]
    return SimpleNamespace(
        encoding=encodings[header[0] % len(encodings)],
        is_bigendian=header[1] & 1,
        width=int.from_bytes(header[2:4], "little"),
        height=int.from_bytes(header[4:6], "little"),
        step=int.from_bytes(header[6:8], "little"),
        data=np.frombuffer(content[8:], np.uint8),
    )


def compressed_message(content: bytes) -> SimpleNamespace:
    """Make a compressed ROS image: the first byte gives its format, the others are its data."""
    formats = ["jpeg", "png", "16UC1; compressedDepth", "32FC1; compressedDepth", "16UC1; compressedDepth rvl", ""]
    message_format = formats[content[0] % len(formats)] if content else ""
    return SimpleNamespace(format=message_format, data=np.frombuffer(content[1:], np.uint8))


def read_bag(path: Path) -> object:
    """Read all frames of a bag."""
    return list(BagSequence(path))


def extract_archive(path: Path) -> object:
    folder = path.with_name("extracted")
    try:
        return extract_tar(path, folder, max_bytes=1 << 20)
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # an existing folder is an error


def read_metres(path: Path) -> torch.Tensor:
    """Read a depth file in units of 1/5000 m, or in metres."""
    return depth_to_metres(read_depth_file(path), 5000.0)


CAMERA = PinholeCamera(fx=8.0, fy=8.0, cx=3.5, cy=2.5, width=8, height=6)

PARSERS: dict[str, Parser] = {
    "image list": from_file("rgb.txt", read_image_list),
    "associations": from_file("associations.txt", read_associations),
    "trajectory": from_file("groundtruth.txt", read_trajectory),
    "gravity": from_file("gravity.txt", lambda path: read_gravity_file(path, 1.5)),
    "matrix": from_file("pose.txt", read_matrix),
    "pose": from_file("pose.txt", lambda path: read_poses({0.0: path})),
    "info.txt": from_file("info.txt", read_sensor_info),
    "camera.yaml": from_file("camera.yaml", load_camera),
    "K.txt": from_file("K.txt", load_camera),
    "configuration": from_file("config.yaml", load_config),
    "--set": parse_overrides,
    "colour file": from_file("image.png", read_colour),
    "JPEG file": from_file("image.jpg", read_colour),
    "depth file": from_file("image.png", read_metres),
    "NumPy depth file": from_file("image.npy", read_metres),
    "POV-Ray depth file": from_file("scene_00_0000.depth", icl_nuim._read_numbers),
    "colour in a message": lambda content, folder: decode_colour(content, "topic"),
    "depth in a message": lambda content, folder: decode_depth(content, "topic"),
    "colour message": lambda content, folder: decode_colour_message(image_message(content), "topic"),
    "depth message": lambda content, folder: depth_to_metres(
        decode_depth_message(image_message(content), "topic"), 1000.0
    ),
    "compressed colour message": lambda content, folder: decode_colour_message(compressed_message(content), "topic"),
    "compressed depth message": lambda content, folder: depth_to_metres(
        decode_depth_message(compressed_message(content), "topic"), 1000.0
    ),
    "sensors.yaml": from_file("sensors.yaml", openloris._read_camera),
    "trans_matrix.yaml": from_file("trans_matrix.yaml", openloris._read_transforms),
    "ROS 1 bag": from_file("take.bag", read_bag),
    "ROS 2 bag": from_file("take.db3", read_bag),
    "mcap": from_file("take.mcap", read_bag),
    "archive": from_file("archive.tgz", extract_archive),
    "map": from_file("room.map", lambda path: load_map(path, CAMERA, Config())),
    "occupancy": from_file("occupancy.npz", load_occupancy),
    "metrics.json": from_file("metrics.json", metrics_file.read_metrics),
    "point map": from_file("map.ply", read_ply_points),
    "request.yaml": from_file("request.yaml", lambda path: read_request(path.parent)),
    "table": from_file("frames.parquet", lambda path: stored_run._read_table(path, ("frame", "status"))),
}


def parse(parser: str, content: bytes, folder: Path) -> object | V3DError:
    """Return the result of a parser or its V3DError.

    Raises:
        AssertionError: If the error has no message.
        Exception: Any other exception of the parser, which is a defect.
    """
    try:
        return PARSERS[parser](content, folder)
    except V3DError as error:
        assert str(error)
        return error


def assert_valid(result: object) -> None:
    """Check the invariants of a parsed result."""
    if isinstance(result, V3DError):
        assert str(result).strip()
    elif isinstance(result, Trajectory):
        assert torch.isfinite(result.T_wc).all() and torch.isfinite(result.stamps).all()
        assert (result.stamps.diff() > 0).all()
        R = result.T_wc[:, :3, :3]
        torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), rtol=0, atol=0.02)
    elif isinstance(result, PinholeCamera):
        assert math.isfinite(result.cx + result.cy + sum(result.distortion))
        assert min(result.fx, result.fy, result.width, result.height) >= 1
        assert result.depth_scale is None or result.depth_scale >= 1
    elif isinstance(result, torch.Tensor) and result.shape == (3,):
        torch.testing.assert_close(result.norm(), torch.ones((), dtype=torch.float64))
    elif isinstance(result, torch.Tensor):
        assert result.ndim == 3 and (result.dtype == torch.uint8 or bool((result >= 0).all()))
