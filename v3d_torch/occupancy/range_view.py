"""Range view: the samples of one depth image that are added to the occupancy map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import STORED_UNIT

_MAX_UNITS = 2**16 - 1
"""Maximum stored depth, 13.1 m: rays are cast up to 10 m at most, so a larger depth shows the same free space."""

_STEPS = 0.7548776662466927, 0.5698402909980532
"""Steps of a quasirandom sequence of offsets, which covers the square evenly from the first elements on (Roberts, "The
unreasonable effectiveness of quasirandom sequences", 2018), so that all pixels are used over time."""


@dataclass(frozen=True)
class RangeView:
    """Every n-th row and column of a depth image.

    Attributes:
        row: First row.
        column: First column.
        depth_units: Depth in units of `STORED_UNIT`, at most 13.1 m, 0 = no measurement, uint16, shape :math:`(h, w)`.
        static: Mask of samples that are static and whose neighbours are static, bool, shape :math:`(h, w)`: masks are
            inaccurate by some pixels, so samples next to a moving object can belong to it.
    """

    row: int
    column: int
    depth_units: Tensor
    static: Tensor

    @staticmethod
    def sample(number: int, depth: Tensor, static: Tensor, stride: int) -> RangeView:
        """Sample a depth image.

        Args:
            number: Number of the view, from 0, which determines the offset of the samples.
            depth: Depth, metres, float32, shape :math:`(H, W)`; 0 = no measurement.
            static: Mask of static pixels, bool, shape :math:`(H, W)`.
            stride: Every n-th row and column is used, from the offset on.
        """
        row, column = (int(stride * math.modf((number + 1) * step)[0]) for step in _STEPS)
        units = (_samples(depth, row, column, stride) / STORED_UNIT).round()
        units = torch.where(units.isfinite(), units.clamp(max=_MAX_UNITS), 0).to(torch.uint16)
        moving = ~_samples(static, row, column, stride)
        near_moving = max_pool2d(moving[None].to(torch.float32), 3, 1, 1)[0] > 0
        return RangeView(row, column, units, ~near_moving)

    @property
    def depth(self) -> Tensor:
        """Depth, metres, float32, shape :math:`(h, w)`; 0 = no measurement."""
        return self.depth_units.to(torch.float32) * STORED_UNIT

    def rays(self, camera: PinholeCamera, stride: int) -> Tensor:
        """Viewing rays of the samples at unit depth, float32, shape :math:`(h, w, 3)`."""
        return _samples(camera.rays, self.row, self.column, stride)


def _samples(image: Tensor, row: int, column: int, stride: int) -> Tensor:
    """Samples of an image (H, W, ...); their number is the same for every offset."""
    height, width = image.shape[0] // stride, image.shape[1] // stride
    return image[row::stride, column::stride][:height, :width]
