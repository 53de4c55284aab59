"""What keyframes saw standing still, kept for the dense maps that are made of it after all corrections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.mapping.keyframe import Keyframe


@dataclass(frozen=True)
class StaticView:
    """What one keyframe saw standing still.

    Attributes:
        keyframe: whose pose places the view.
        units: depth in units of `StaticViews.UNIT`, 0 = no measurement or not static, uint16, shape :math:`(h, w)`.
        colour: RGB, uint8, shape :math:`(3, h, w)`.
    """

    keyframe: Keyframe
    units: Tensor
    colour: Tensor

    @property
    def T_cw(self) -> Tensor:
        """World to camera, float64, shape :math:`(4, 4)`."""
        return self.keyframe.T_cw

    @property
    def T_wc(self) -> Tensor:
        """Camera to world, float64, shape :math:`(4, 4)`."""
        return invert(self.keyframe.T_cw)

    @property
    def depth(self) -> Tensor:
        """Metres, float32, shape :math:`(h, w)`; 0 = no measurement or not static."""
        return self.units.to(torch.float32) * StaticViews.UNIT


class StaticViews:
    """Images of an ideal pinhole camera that has a pixel for every so manieth of the real one.

    The lens is taken out once, here: what is made of the views projects points by the pinhole alone.

    Args:
        camera: of the frames.
        stride: every n-th pixel is kept, by row and by column.

    Attributes:
        stride: of the views.
        camera: of the views, without distortion.
        rays: exact direction through every pixel at unit depth, float32, shape :math:`(h, w, 3)`.
    """

    UNIT = 0.0002
    """Metres: the unit of TUM's depth images, which divides the millimetre; 16 bits reach 13 m, beyond any use."""

    def __init__(self, camera: PinholeCamera, stride: int) -> None:
        self.stride = stride
        self.camera = PinholeCamera(
            fx=camera.fx / stride,
            fy=camera.fy / stride,
            cx=camera.cx / stride,
            cy=camera.cy / stride,
            width=-(-camera.width // stride),
            height=-(-camera.height // stride),
        )
        rows, columns = torch.arange(0, camera.height, stride), torch.arange(0, camera.width, stride)
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        source = camera.distort(torch.stack([u, v], dim=-1).reshape(-1, 2)).round().to(torch.int64)
        self._u, self._v = source.reshape(*u.shape, 2).unbind(dim=-1)
        self._inside = (self._u >= 0) & (self._u < camera.width) & (self._v >= 0) & (self._v < camera.height)
        self._u, self._v = self._u.clamp(0, camera.width - 1), self._v.clamp(0, camera.height - 1)
        self.rays = camera.rays[self._v, self._u]
        self._views: list[StaticView] = []

    def __len__(self) -> int:
        return len(self._views)

    def __iter__(self) -> Iterator[StaticView]:
        return iter(self._views)

    def add(self, keyframe: Keyframe, image: Tensor, depth: Tensor, static: Tensor) -> None:
        """Keep what a keyframe saw.

        Args:
            keyframe: whose pose will place the view.
            image: uint8 RGB, shape :math:`(3, H, W)`.
            depth: metres, shape :math:`(1, H, W)`.
            static: pixels that stand still, bool, shape :math:`(H, W)`.
        """
        units = (depth[0, self._v, self._u] / self.UNIT).round()
        keep = self._inside & static[self._v, self._u] & (units > 0) & (units < 2**16)
        units = torch.where(keep, units, 0).to(torch.uint16)
        self.append(StaticView(keyframe, units, image[:, self._v, self._u]))

    def append(self, view: StaticView) -> None:
        """Keep a view of this camera, and let go those of keyframes that the map does without by now."""
        self._views = [known for known in self._views if not known.keyframe.is_culled] + [view]
