"""Scale pyramid of an image."""

from __future__ import annotations

from itertools import count

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.config import FeaturesConfig

_MAX_COLUMNS = 1000
"""Maximum number of columns of the finest level. The pixels of larger images show blur and noise rather than corners,
and eight levels would not reach features that are coarse enough for a camera that moves fast."""


def octaves_of_levels(config: FeaturesConfig, columns: int) -> range:
    """Return the octaves of a pyramid's levels; in a large image, the first is the finest with at most 1000 columns.

    Args:
        config: Number of levels, and scale factor between octaves.
        columns: Number of columns of the image.
    """
    first = next(octave for octave in count() if round(columns / config.scale**octave) <= _MAX_COLUMNS)
    return range(first, first + config.levels)


class ScalePyramid:
    """Scale pyramid with all levels in one image, one below the other, so that a filter runs once for all levels.

    Args:
        width: Columns of the image.
        height: Rows of the image.
        octaves: Octaves of the levels, ascending; levels smaller than twice the margin are left out, except the first.
        scale: Scale factor between octaves; octave 0 is the image.
        margin: Width of the unused border of each level, pixels.

    Attributes:
        sizes: Width and height of each level, pixels.
        tops: First row of each level in the image of all levels.
        boxes: Left, top, right, and bottom of each level without its margin, in the image of all levels, int64, (L, 4).
        level_of_row: Level of each row of the image of all levels, int64.
    """

    def __init__(self, width: int, height: int, octaves: range, scale: float, margin: int) -> None:
        sizes = [(round(width / scale**octave), round(height / scale**octave)) for octave in octaves]
        self.sizes = [size for level, size in enumerate(sizes) if level == 0 or min(size) > 2 * margin]
        rows = [size[1] for size in self.sizes]
        self.tops = np.cumsum([0, *rows[:-1]])
        self._shape = sum(rows), self.sizes[0][0]
        self.level_of_row = np.arange(len(rows)).repeat(rows)
        left, columns = np.full_like(self.tops, margin), np.array(self.sizes)[:, 0]
        self.boxes = np.stack([left, self.tops + margin, columns - margin, self.tops + rows - margin], axis=1)

    def build(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image of all levels of a grey image, uint8."""
        canvas = np.empty(self._shape, np.uint8)
        level = canvas[: self.sizes[0][1]]
        cv2.resize(grey, self.sizes[0], dst=level, interpolation=cv2.INTER_AREA)
        for top, (width, height) in zip(self.tops[1:].tolist(), self.sizes[1:], strict=True):
            level = np.asarray(cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
            rows = canvas[top : top + height]
            rows[:, :width] = level
            rows[:, width:] = level[:, -1:]  # repeat the last column, so that there is no edge beside the level
        return canvas
