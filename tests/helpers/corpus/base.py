"""The intact sequence that the cases damage: 0.8 s in TUM layout, a camera that moves along a textured wall."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory

WIDTH, HEIGHT, FRAMES = 128, 96, 8
FOCAL, SCALE, DEPTH = 64.0, 5000, 1.0
STEP = 2
"""Motion of the image between two frames, pixels."""
CAMERA = (
    f"fx: {FOCAL}\nfy: {FOCAL}\ncx: {(WIDTH - 1) / 2}\ncy: {(HEIGHT - 1) / 2}\n"
    f"width: {WIDTH}\nheight: {HEIGHT}\ndepth_scale: {SCALE}\nreadout: 0\n"
)
NOISE = np.random.default_rng(2).integers(0, 256, 5000, dtype=np.uint8).tobytes()
STAMPS = [f"{1305031102 + i / 10:.6f}" for i in range(FRAMES)]


def colour(x: int, y: int = 0) -> NDArray[np.uint8]:
    """Colour image at a camera position on the wall (pixels), BGR, shape (H, W, 3)."""
    noise = np.random.default_rng(0).integers(0, 256, (40, 56, 3), dtype=np.uint8)
    wall = cv2.resize(noise, (168, 120), interpolation=cv2.INTER_CUBIC)
    return wall[y : y + HEIGHT, x : x + WIDTH]


def depth(metres: float = DEPTH) -> NDArray[np.uint16]:
    """Depth image of the wall at a constant distance, shape (H, W)."""
    return np.full((HEIGHT, WIDTH), metres * SCALE, np.uint16)


def png(image: NDArray[np.generic]) -> bytes:
    """Encode an image as PNG."""
    return cv2.imencode(".png", image)[1].tobytes()


def camera_position(frame: int) -> tuple[int, int]:
    """Position of the camera on the wall, pixels: it moves to the right, and up and down."""
    return STEP * frame, 4 + 2 * (frame % 4)


def write_base(folder: Path) -> None:
    """Write the sequence with its ground truth and camera."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    T_wc = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    for i, stamp in enumerate(STAMPS):
        (folder / "rgb" / f"{stamp}.png").write_bytes(png(colour(*camera_position(i))))
        (folder / "depth" / f"{stamp}.png").write_bytes(png(depth()))
        T_wc[i, :2, 3] = torch.tensor(camera_position(i)) * DEPTH / FOCAL
        # A tiny rotation: constant orientations count as placeholders in the evaluation.
        T_wc[i, :3, :3] = se3_exp(torch.tensor([0, 0, 0, 1e-6 * i, 0, 0], dtype=torch.float64))[:3, :3]
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(f"{stamp} {kind}/{stamp}.png\n" for stamp in STAMPS))
    (folder / "camera.yaml").write_text(CAMERA)
    stamps = torch.tensor([float(stamp) for stamp in STAMPS], dtype=torch.float64)
    write_trajectory(folder / "groundtruth.txt", Trajectory(stamps, T_wc))
