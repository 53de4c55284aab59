"""Scale pyramid of an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


class ScalePyramid:
    """Pyramid whose levels lie one below the other in one image, so that a filter runs once for all of them.

    Args:
        width: Columns of the image.
        height: Rows of the image.
        levels: Number of levels; those that are smaller than twice the margin are left out.
        scale: Scale factor between levels.
        margin: Distance from the border of a level up to which its pixels are not used, pixels.

    Attributes:
        sizes: Width and height of each level, pixels.
        tops: First row of each level in the image of all levels.
    """

    def __init__(self, width: int, height: int, levels: int, scale: float, margin: int) -> None:
        sizes = [(round(width / scale**level), round(height / scale**level)) for level in range(levels)]
        self.sizes = [size for level, size in enumerate(sizes) if level == 0 or min(size) > 2 * margin]
        rows = [size[1] for size in self.sizes]
        self.tops = np.cumsum([0, *rows[:-1]])
        self._shape = sum(rows), width
        self._level_of_row = np.arange(len(rows)).repeat(rows)
        inside = np.zeros(self._shape, np.bool_)
        for top, (columns, height) in zip(self.tops.tolist(), self.sizes, strict=True):
            inside[top + margin : top + height - margin, margin : columns - margin] = True
        self._is_inside = inside.ravel()

    def build(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image of all levels of a grey image, uint8."""
        canvas = np.empty(self._shape, np.uint8)
        level = canvas[: len(grey)]
        level[:] = grey
        for top, (width, height) in zip(self.tops[1:].tolist(), self.sizes[1:], strict=True):
            level = np.asarray(cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
            rows = canvas[top : top + height]
            rows[:, :width] = level
            rows[:, width:] = level[:, -1:]  # no edge beside the level
        return canvas

    def locate(self, column: NDArray[np.int64], row: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Locate pixels of the image of all levels.

        Returns:
            True for pixels of a level outside of its margin, bool, and the level, int64, each of shape :math:`(N,)`.
        """
        return self._is_inside[row * self._shape[1] + column], self._level_of_row[row]
