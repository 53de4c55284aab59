"""Small random images for the tests of data sets, determined by their seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

WIDTH, HEIGHT = 32, 24
CAMERA_YAML = f"fx: 30.0\nfy: 31\ncx: 15.5\ncy: 11.5\nwidth: {WIDTH}\nheight: {HEIGHT}\ndepth_scale: 1000\n"


def colour_of(seed: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """Random colour image, RGB, shape (H, W, 3)."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def depth_of(seed: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint16]:
    """Random depth image in units of the file, shape (H, W); about a tenth of the pixels is 0."""
    units = np.random.default_rng(seed + 100).integers(0, 60000, (height, width), dtype=np.uint16)
    return np.where(units < 6000, 0, units).astype(np.uint16)


def save(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Save an image and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def as_rgb(image: Tensor) -> NDArray[np.uint8]:
    """Convert the image of a frame to the layout of `colour_of`."""
    return image.permute(1, 2, 0).numpy()
