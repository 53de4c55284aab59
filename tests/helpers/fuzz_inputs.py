"""Valid inputs of all parsers in `parsers`, from which fuzzing starts."""

from __future__ import annotations

import json
import struct
import tarfile
import tempfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from PIL import Image

from helpers.bags import DEPTH, INFO, RGB, Kind, MessageFactory
from helpers.camera_files import FILES
from helpers.parsers import CAMERA
from v3d_torch.config import Config, OccupancyConfig
from v3d_torch.datasets.ros.encodings import COLOUR_ENCODINGS
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.io.ply import write_ply
from v3d_torch.mapping.map_io import save_map
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_io import save_occupancy
from v3d_torch.occupancy.occupancy_map import OccupancyMap
from v3d_torch.runs.request import RunRequest, write_request


def _map() -> bytes:
    """Map with two keyframes of 8x6 pixels that observe the same two landmarks."""
    config = Config()
    sparse_map, views = SparseMap(config.mapping, config.features, CAMERA), StaticViews(CAMERA, stride=2)
    uv = torch.tensor([[1.0, 2.0], [5.0, 3.0]], dtype=torch.float64)
    numbers = torch.zeros(2, dtype=torch.int64)
    features = Features(
        uv, uv.long(), torch.ones(2, dtype=torch.float64), numbers, torch.ones(2, 32, dtype=torch.uint8)
    )
    for index, landmarks in enumerate(([-1, -1], [0, 1])):
        T_cw = se3_exp(torch.full((6,), 0.1 * index, dtype=torch.float64))
        keyframe = sparse_map.insert_keyframe(index, 0.1 * index, T_cw, features, torch.tensor(landmarks))
        image = torch.full((3, 6, 8), 9, dtype=torch.uint8)
        views.add(keyframe, image, torch.ones(1, 6, 8), torch.ones(6, 8, dtype=torch.bool))
    with tempfile.TemporaryDirectory() as folder:
        save_map(Path(folder) / "map", sparse_map, views)
        return (Path(folder) / "map").read_bytes()


def _occupancy() -> bytes:
    """Occupancy map of a wall that a camera of 8x6 pixels observes."""
    occupancy = OccupancyMap(OccupancyConfig())
    depth, static = torch.ones(6, 8), torch.ones(6, 8, dtype=torch.bool)
    occupancy.integrate(depth, static, CAMERA.rays, torch.eye(4, dtype=torch.float64))
    with tempfile.TemporaryDirectory() as folder:
        floor = Floor(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), -1.0, 0.5)
        save_occupancy(Path(folder) / "occupancy.npz", occupancy, floor)
        return (Path(folder) / "occupancy.npz").read_bytes()


def _point_map() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.ply"
        write_ply(path, torch.ones(2, 3), torch.ones(2, 3, dtype=torch.uint8), normals=torch.ones(2, 3))
        return path.read_bytes()


def _request() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_request(Path(folder), RunRequest("demo", Config(), fps=30.0, save_masks=True))
        return (Path(folder) / "request.yaml").read_bytes()


def _table() -> bytes:
    file = BytesIO()
    pq.write_table(pa.table({"frame": [0, 1], "status": ["tracked", "lost"]}), file)
    return file.getvalue()


def _bag(kind: Kind) -> bytes:
    """Bag with one frame of 8x6 pixels."""
    make_message = MessageFactory(kind)
    matrix = [8.0, 0, 3.5, 0, 8.0, 2.5, 0, 0, 1]
    pixels = np.arange(48, dtype=np.uint16).reshape(6, 8) + 1000
    messages = [
        (INFO, 1.0, make_message.info(8, 6, matrix, [], [*matrix[:3], 0, *matrix[3:6], 0, *matrix[6:], 0])),
        (RGB, 1.0, make_message.image(1.0, "mono8", pixels.astype(np.uint8))),
        (DEPTH, 1.0, make_message.image(1.0, "16UC1", pixels)),
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = make_message.write(Path(folder) / "take", messages)
        return (path if kind == "bag" else next(path.glob(f"*.{kind}"))).read_bytes()


def _tar(mode: str) -> bytes:
    file = BytesIO()
    with tarfile.open(fileobj=file, mode=mode) as tar:
        for name in ("seq/rgb.txt", "seq/" + 120 * "x", "seq/depth/1.png"):
            info = tarfile.TarInfo(name)
            info.size = 5
            tar.addfile(info, BytesIO(b"12345"))
    return file.getvalue()


def _image(file_format: str, mode: str) -> bytes:
    file = BytesIO()
    pixels = np.arange(48, dtype=np.uint16 if mode == "I;16" else np.uint8).reshape(6, 8)
    Image.fromarray(pixels).convert(mode if mode != "I;16" else None).save(file, file_format)
    return file.getvalue()


def _array(dtype: str) -> bytes:
    """NumPy array of 8x6 pixels."""
    file = BytesIO()
    np.save(file, np.arange(48).reshape(6, 8).astype(dtype))
    return file.getvalue()


def _message(encoding: int, pixel: int) -> bytes:
    """Image of 8x6 pixels in the format of `image_message`."""
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
_METRICS = {
    **{"sequence": "a", "frames": 2, "processed": 2, "status": ["tracked", "lost"], "keyframes": 1, "landmarks": 2},
    **{"loops": 0, "failure": None, "fps": 3.5, "seconds": 0.6, "seconds_per_stage": {"read": 0.1}, "seed": 0},
    **{"peak_memory_mb": 300.0, "masks": None, "versions": {"torch": "2"}, "machine": {"threads": 1}},
}
_YAML = (
    b"seed: 3\nobjects:\n  voting: {distance_threshold: 0.1, time_spans: [0.0, 0.3]}\ncheckpoint: {interval: .inf}\n"
)

_INFO = b"""m_depthShift = 1000.000000
m_calibrationColorIntrinsic = 1170.2 0 647.7 0 0 1170.2 483.7 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 572.0 0 320.0 0 0 572.0 240.0 0 0 0 1 0 0 0 0 1
"""

SEEDS: dict[str, list[bytes]] = {
    "image list": [_LIST],
    "associations": [b"1.5 rgb/1.png 1.51 depth/1.png\n2 rgb/a 2.png 2.0 depth/a, b.png\n"],
    "trajectory": [_POSES, b"1403636579763555584 0 0 0 0 0 0 1\n"],
    "gravity": [b"# stamp gx gy gz\n1.5 0.6 0.0 -0.8\n", b"1.5,0,1,0\n"],
    "matrix": [_POSE, b"525 0 319.5\n0 525 239.5\n0 0 1\n"],
    "pose": [_POSE, _POSE.replace(b"-inf", b"1")],
    "camera.yaml": [_CAMERA, *(text.encode() for text, _ in FILES.values())],
    "K.txt": [b"525 525 319.5 239.5 5000 640 480\n", b"525 0 319.5\n0 525 239.5\n0 0 1\n"],
    "configuration": [_YAML],
    "--set": [b"objects.voting.distance_threshold=0.1\nseed=3\nfeatures={count: 30}\n"],
    "colour file": _RASTERS,
    "JPEG file": _JPEGS,
    "depth file": _RASTERS,
    "NumPy depth file": [_array(dtype) for dtype in ("float32", "uint16", ">f8")],
    "POV-Ray depth file": [b"1.5 2.25 3e0\n4 5.125\n"],
    "colour in a message": _RASTERS,
    "depth in a message": _RASTERS,
    "colour message": [_message(i, COLOUR_ENCODINGS[encoding][0]) for i, encoding in enumerate(COLOUR_ENCODINGS)],
    "depth message": [_message(len(COLOUR_ENCODINGS), 2), _message(len(COLOUR_ENCODINGS) + 2, 4)],
    "compressed colour message": [b"\0" + image for image in _RASTERS],
    "compressed depth message": [bytes([i]) + struct.pack("<iff", 0, 1.0, 0.0) + _PNGS[-1] for i in (2, 3)]
    + [b"\1" + _PNGS[-1]],
    "sensors.yaml": [_SENSORS],
    "info.txt": [_INFO],
    "trans_matrix.yaml": [_LINKS],
    "ROS 1 bag": [_bag("bag")],
    "ROS 2 bag": [_bag("db3")],
    "mcap": [_bag("mcap")],
    "map": [_map()],
    "occupancy": [_occupancy()],
    "point map": [_point_map()],
    "request.yaml": [_request()],
    "metrics.json": [json.dumps(_METRICS).encode()],
    "table": [_table()],
    "archive": [_tar(mode) for mode in ("w", "w:gz", "w:bz2", "w:xz")],
}
"""Valid inputs of each parser."""
