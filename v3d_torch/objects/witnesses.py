"""The features' word on who stands still: those that fit the camera's motion as well as the rest of the image does.

A person whom nobody has seen move yet is taken for moving, to be safe. But the network also takes rolled furniture for
people, now and then for most of the image, and then nothing is left to track the camera by. The features tell: on who
walks few fit the motion that the rest of the image agrees on.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Witnesses:
    """Features of a frame.

    Attributes:
        pixel: (column, row), int64, shape :math:`(N, 2)`.
        fits: whether it was found in the frame before, and fits the camera's motion since, bool, shape :math:`(N,)`.
    """

    pixel: Tensor
    fits: Tensor

    def vouch_for(self, masks: Tensor, share: float, least: int) -> Tensor:
        """For which objects they vouch.

        Args:
            masks: of objects, bool, shape :math:`(K, H, W)`.
            share: of an object's features so many must fit, in shares of how many fit outside of all objects.
            least: and at least so many.

        Returns:
            bool, shape :math:`(K,)`.
        """
        inside = masks[:, self.pixel[:, 1], self.pixel[:, 0]]
        outside = ~inside.any(dim=0)
        usual = (self.fits & outside).sum() / outside.sum().clamp(min=1)
        fitting, all_ = (inside & self.fits).sum(dim=1), inside.sum(dim=1)
        return (fitting >= least) & (fitting >= share * usual * all_)
