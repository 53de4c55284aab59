"""Pixels of drawn figures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray


def read_picture(path: Path) -> NDArray[np.float64]:
    """Read an image as RGB between 0 and 1, shape (H, W, 3)."""
    return cv2.imread(str(path), cv2.IMREAD_COLOR_RGB) / 255.0


def is_colour(picture: NDArray[np.float64], colour: str) -> NDArray[np.bool_]:
    """Return the pixels of a colour of matplotlib, shape (H, W)."""
    return np.abs(picture - to_rgb(colour)).max(axis=2) < 0.02


def count_pixels(picture: NDArray[np.float64], colour: str) -> int:
    """Count the pixels of a colour of matplotlib."""
    return int(is_colour(picture, colour).sum())
