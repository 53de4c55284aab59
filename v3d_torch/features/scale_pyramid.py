"""Scale pyramid of an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


class ScalePyramid:
    """Scale pyramid with all levels in one image, one below the other, so that a filter runs once for all levels.

    Args:
        width: Columns of the image.
        height: Rows of the image.
        levels: Number of levels; levels smaller than twice the margin are left out.
        scale: Scale factor between levels.
        margin: Width of the unused border of each level, pixels.

    Attributes:
        sizes: Width and height of each level, pixels.
        tops: First row of each level in the image of all levels.
        boxes: Left, top, right, and bottom of each level without its margin, in the image of all levels, int64, (L, 4).
        level_of_row: Level of each row of the image of all levels, int64.
    """

    def __init__(self, width: int, height: int, levels: int, scale: float, margin: int) -> None:
        sizes = [(round(width / scale**level), round(height / scale**level)) for level in range(levels)]
        self.sizes = [size for level, size in enumerate(sizes) if level == 0 or min(size) > 2 * margin]
        rows = [size[1] for size in self.sizes]
        self.tops = np.cumsum([0, *rows[:-1]])
        self._shape = sum(rows), width
        self.level_of_row = np.arange(len(rows)).repeat(rows)
        left, columns = np.full_like(self.tops, margin), np.array(self.sizes)[:, 0]
        self.boxes = np.stack([left, self.tops + margin, columns - margin, self.tops + rows - margin], axis=1)

    def build(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image of all levels of a grey image, uint8."""
        canvas = np.empty(self._shape, np.uint8)
        level = canvas[: len(grey)]
        level[:] = grey
        for top, (width, height) in zip(self.tops[1:].tolist(), self.sizes[1:], strict=True):
            level = np.asarray(cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
            rows = canvas[top : top + height]
            rows[:, :width] = level
            rows[:, width:] = level[:, -1:]  # repeat the last column, so that there is no edge beside the level
        return canvas
