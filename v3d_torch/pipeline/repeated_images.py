"""Detection of images that repeat the one before, as in recordings of a camera that is slower than its stream."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_STRIDE = 16
"""Stride of the rows and columns that are compared first, because most images differ there."""

_MIN_FRACTION = 0.05
"""Fraction of repeated images above which they are warned of: a few do not change the path."""

_MIN_STUCK = 9
"""Minimum number of copies in a row of a stream that is stuck. A camera that is slower than its stream has fewer, and a
short test can repeat one image."""


@dataclass
class RepeatedImages:
    """Counts images that equal the one before. Uniform images are not counted: images in the dark are all equal.

    Attributes:
        count: Number of such images so far.
        longest: Largest number of them in a row.
        in_a_row: Number of the newest ones in a row.
        newest: Newest image, shape :math:`(C, H, W)`; None before the first one.
    """

    count: int = 0
    longest: int = 0
    in_a_row: int = 0
    newest: Tensor | None = None

    def add(self, image: Tensor) -> None:
        """Compare a colour or depth image with the one before, shape :math:`(C, H, W)`."""
        is_repeated = self.newest is not None and _are_equal(self.newest, image) and not _is_uniform(image)
        self.count += is_repeated
        self.in_a_row = self.in_a_row + 1 if is_repeated else 0
        self.longest = max(self.longest, self.in_a_row)
        self.newest = image

    def check(self, frames: int, images: str = "images") -> list[str]:
        """Return a warning if many of the images repeat the one before: the camera stops, or its stream is stuck.

        Args:
            frames: Number of images.
            images: Name of the images in the warning.
        """
        if self.count <= _MIN_FRACTION * frames:
            return []
        if 2 * self.longest > self.count and self.longest >= _MIN_STUCK:
            return [
                f"{self.longest + 1} of {frames} {images} in a row are equal: the stream seems to be stuck, because"
                " images of a camera have noise; record or export them again"
            ]
        if self.count == frames - 1:
            return []
        return [
            f"{self.count} of {frames} {images} are equal to the one before: the stream seems to stop and jump, which"
            " makes velocities, readout and path less accurate; leave out the copies"
        ]


def _are_equal(a: Tensor, b: Tensor) -> bool:
    """Compare images, shape (C, H, W): first a part of the pixels."""
    return torch.equal(a[:, ::_STRIDE, ::_STRIDE], b[:, ::_STRIDE, ::_STRIDE]) and torch.equal(a, b)


def _is_uniform(image: Tensor) -> bool:
    """Check whether all pixels of an image, shape (C, H, W), are equal."""
    return bool((image == image[:, :1, :1]).all())
