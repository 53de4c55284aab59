"""Detection of images that repeat the one before, as in recordings of a camera that is slower than its stream."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_STRIDE = 16
"""Stride of the rows and columns that are compared first, because most images differ there."""

_MIN_FRACTION = 0.05
"""Fraction of repeated images above which they are warned of: a few do not change the path."""


@dataclass
class RepeatedImages:
    """Counts images that equal the one before.

    Attributes:
        count: Number of such images so far.
        newest: Newest image, uint8, shape :math:`(3, H, W)`; None before the first one.
    """

    count: int = 0
    newest: Tensor | None = None

    def add(self, image: Tensor) -> None:
        """Compare an image with the one before, uint8, shape :math:`(3, H, W)`."""
        if self.newest is not None and self.newest.shape == image.shape:
            sampled = (each[:, ::_STRIDE, ::_STRIDE] for each in (self.newest, image))
            self.count += torch.equal(*sampled) and torch.equal(self.newest, image)
        self.newest = image

    def check(self, frames: int) -> list[str]:
        """Return a warning if many of the frames repeat the one before, but not all: then nothing moves."""
        if not _MIN_FRACTION * frames < self.count < frames - 1:
            return []
        return [
            f"{self.count} of {frames} images are equal to the one before: the camera seems to stop and jump, which"
            " makes velocities, readout and path less accurate; leave out the copies"
        ]
