"""Rendering of a scene as a sequence in the layout of the TUM RGB-D benchmark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.scene import Scene
from v3d_torch.datasets.demo.scenes import SCENES
from v3d_torch.datasets.demo.sensor_model import simulate_colour, simulate_depth
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.timestamps import format_timestamp

CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, depth_scale=5000.0, readout=0.0)
"""Default calibration of a Kinect, with a global shutter: all rows of a rendered image have the same time."""
FRAME_COUNT = 120
"""Number of frames."""
FRAME_RATE = 30.0
"""Frame rate, Hz."""
START_STAMP = 1.0
"""Timestamp of the first frame, seconds."""
SEED = 7
"""Seed of textures and sensor noise."""

Image = NDArray[np.uint8] | NDArray[np.uint16]
Progress = Callable[[int, int], None]
"""Called with the number of frames done and the number of all frames."""


def write_sequence(
    folder: Path, frames: range = range(FRAME_COUNT), progress: Progress | None = None, name: str = "demo"
) -> None:
    """Render frames of a built-in sequence into an empty folder.

    Args:
        folder: Folder for ``rgb/``, ``depth/``, ``masks/``, ``instances/`` and the lists; created if missing.
        frames: Indices of the frames to render; the bytes of a frame do not depend on the others.
        progress: Called after every frame.
        name: Name of the sequence.
    """
    for subfolder in ("rgb", "depth", "masks", "instances"):
        (folder / subfolder).mkdir(parents=True, exist_ok=True)
    scene = SCENES[name](SEED)
    with _single_thread():
        renderer = Renderer(scene, CAMERA)
        for done, index in enumerate(frames, start=1):
            _write_frame(folder, renderer, index)
            if progress is not None:
                progress(done, len(frames))
    _write_lists(folder, scene, frames)


@contextmanager
def _single_thread() -> Iterator[None]:
    """Run torch on one thread: rendering is many small operations, which are slower with threads on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _stamp(index: int) -> str:
    return format_timestamp(START_STAMP + index / FRAME_RATE)


def _write_frame(folder: Path, renderer: Renderer, index: int) -> None:
    time = index / FRAME_RATE
    rendering = renderer(renderer.scene.trajectory.pose(time), time)
    generator = torch.Generator().manual_seed(SEED * 100_003 + index)  # a different seed for each frame
    colour = simulate_colour(rendering.colour, generator).numpy()
    depth = simulate_depth(rendering.depth, CAMERA, generator).numpy()
    stamp = _stamp(index)
    _write_image(folder / "rgb" / f"{stamp}.jpg", np.ascontiguousarray(colour[..., ::-1]))
    _write_image(folder / "depth" / f"{stamp}.png", (depth * CAMERA.depth_scale).round().astype(np.uint16))
    _write_image(folder / "masks" / f"{stamp}.png", rendering.motion_mask.numpy())
    _write_image(folder / "instances" / f"{stamp}.png", rendering.instance_mask.numpy())


def _write_image(path: Path, image: Image) -> None:
    # Encode and write separately, because cv2.imwrite does not report the cause of a failure.
    encoded = cv2.imencode(path.suffix, image)[1]  # JPEG with OpenCV's default quality of 95
    path.write_bytes(encoded.tobytes())


def _write_lists(folder: Path, scene: Scene, frames: range) -> None:
    """Write the image lists, the ground truth, the camera file and the classes of the instances."""
    stamps = [_stamp(index) for index in frames]
    poses = np.stack([scene.trajectory.pose(index / FRAME_RATE) for index in frames])
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    groundtruth = [
        f"{stamp} " + " ".join(f"{value:.9f}" for value in (*T_wc[:3, 3], *q))
        for stamp, T_wc, q in zip(stamps, poses, quaternions, strict=True)
    ]
    lists = {
        "rgb.txt": ["# timestamp filename", *(f"{s} rgb/{s}.jpg" for s in stamps)],
        "depth.txt": ["# timestamp filename", *(f"{s} depth/{s}.png" for s in stamps)],
        "associations.txt": [f"{s} rgb/{s}.jpg {s} depth/{s}.png" for s in stamps],
        "groundtruth.txt": ["# camera-to-world", "# timestamp tx ty tz qx qy qz qw", *groundtruth],
        "camera.yaml": [
            *(f"{key}: {getattr(CAMERA, key)}" for key in ("width", "height", "fx", "fy", "cx", "cy")),
            f"distortion: {list(CAMERA.distortion)}  # k1 k2 p1 p2 k3 (OpenCV)",
            f"depth_scale: {CAMERA.depth_scale:g}  # units per metre",
            f"readout: {CAMERA.readout}  # seconds from the first row to the last",
        ],
    }
    labels = [f"{instance}: {label}" for instance, label in sorted(scene.labels.items())]
    (folder / "instances" / "labels.yaml").write_text("\n".join(labels) + "\n", encoding="utf-8")
    for name, lines in lists.items():
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
