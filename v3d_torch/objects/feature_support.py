"""The features' word on who stands still: those that fit the camera's motion as well as the rest of the image does.

A person whom nobody has seen move yet is taken for moving, to be safe. But the network also takes rolled furniture for
people, now and then for most of the image, and then nothing is left to track the camera by. The features tell: on who
walks few fit the motion that the rest of the image agrees on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class FeatureSupport:
    """Features of a frame.

    Attributes:
        pixel: (column, row), int64, shape :math:`(N, 2)`.
        fits: whether it was found in the frame before, and fits the camera's motion since, bool, shape :math:`(N,)`.
    """

    pixel: Tensor
    fits: Tensor

    def supports(self, masks: Sequence[Tensor], share: float, least: int) -> Tensor:
        """For which objects they vouch.

        Args:
            masks: of K objects, bool, each of shape :math:`(H, W)`.
            share: of an object's features so many must fit, in shares of how many fit outside of all objects.
            least: and at least so many.

        Returns:
            bool, shape :math:`(K,)`.
        """
        if len(masks) == 0:
            return self.fits.new_zeros(0)
        place = self.pixel[:, 1] * masks[0].shape[1] + self.pixel[:, 0]
        inside = torch.stack([mask.flatten().index_select(0, place) for mask in masks])
        outside = ~inside.any(dim=0)
        usual = (self.fits & outside).sum() / outside.sum().clamp(min=1)
        fitting, all_ = (inside & self.fits).sum(dim=1), inside.sum(dim=1)
        return (fitting >= least) & (fitting >= share * usual * all_)
