"""Pixels of a frame that appeared, from the free-space check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from v3d_torch.geometry.packed_masks import count_common_pixels, count_pixels, pack_masks

MIN_REGION_SIDE = 3
"""Side of the smallest square of pixels that is a region that appeared: fewer are depth noise. Pixels of
`AppearedPixels`."""


@dataclass(frozen=True)
class AppearedPixels:
    """Pixels whose point lies in space that earlier views observed as free.

    Attributes:
        was_free: For each of B time spans, 1 if the space was free, 0 if it was occupied, NaN if unknown; float64,
            every ``stride``-th pixel, shape :math:`(B, h, w)`.
        stride: Step between the pixels, pixels.
    """

    was_free: Tensor
    stride: int

    @cached_property
    def appeared(self) -> Tensor:
        """Pixels whose space was free over some time span, bool, shape :math:`(h, w)`."""
        return torch.from_numpy((self.was_free.numpy() == 1).any(axis=0))  # NumPy is faster here than torch

    @property
    def was_occupied(self) -> Tensor:
        """Pixels whose space was occupied over some time span and free over none, bool, shape :math:`(h, w)`."""
        return torch.from_numpy((self.was_free.numpy() == 0).any(axis=0) & ~self.appeared.numpy())

    def fractions(self, packed: Sequence[Tensor], min_pixels: Sequence[int], of_all: Sequence[bool]) -> Tensor:
        """Return the fraction of each object's pixels that appeared.

        Args:
            packed: Masks of K objects, packed with the stride (see `pack_masks`), uint8, each of shape :math:`(B',)`.
            min_pixels: Minimum number of known pixels of each object.
            of_all: True for a fraction of all pixels of the object, false for a fraction of the known ones; K elements.

        Returns:
            Fraction for each object and time span, NaN if too few pixels are known; float64, shape :math:`(K, B)`.
        """
        rows = len(self.was_free)
        if not packed:
            return self.was_free.new_zeros(0, rows)
        inside = torch.stack(list(packed))
        indicators = pack_masks(torch.cat([self.was_free == 1, ~self.was_free.isnan()]))
        counts = count_common_pixels(inside, indicators).to(torch.float64)
        new, known = counts[:, :rows], counts[:, rows:]
        total = torch.where(torch.tensor(of_all)[:, None], count_pixels(inside)[:, None], known)
        return (new / total).masked_fill(known < torch.tensor(min_pixels)[:, None], torch.nan)
