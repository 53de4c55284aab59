"""Static depth and colour images of keyframes, stored for dense reconstruction after all corrections."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.errors import ConfigError
from v3d_torch.geometry.argument_checks import check_masks, check_shape
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import STORED_UNIT
from v3d_torch.geometry.se3 import invert
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.runtime.stateful import StatefulComponent


@dataclass(frozen=True)
class StaticView:
    """Static depth and colour image of one keyframe.

    Attributes:
        keyframe: Keyframe from whose frame the images are.
        depth_units: Depth in units of `STORED_UNIT`, 0 = no measurement or not static, uint16,
            shape :math:`(h, w)`.
        colour: RGB, uint8, shape :math:`(3, h, w)`.
        T_dc: Motion of the camera from the time of the colour image to that of the depth image: it maps points of the
            camera frame "c" at the former to "d" at the latter, float64, shape :math:`(4, 4)`.
        depth_delay: Time of the depth image minus time of the colour image by their timestamps, seconds.
    """

    keyframe: Keyframe
    depth_units: Tensor
    colour: Tensor
    T_dc: Tensor
    depth_delay: float = 0.0

    @property
    def T_dw(self) -> Tensor:
        """World-to-camera pose at the time of the depth image, float64, shape :math:`(4, 4)`."""
        return self.T_dc @ self.keyframe.T_cw

    @property
    def T_wd(self) -> Tensor:
        """Camera-to-world pose at the time of the depth image, float64, shape :math:`(4, 4)`."""
        return invert(self.T_dw)

    @property
    def depth(self) -> Tensor:
        """Depth, metres, float32, shape :math:`(h, w)`; 0 = no measurement or not static."""
        return self.depth_units.to(torch.float32) * STORED_UNIT


class StaticViews(StatefulComponent):
    """Static views of keyframes, as images of a pinhole camera of lower resolution without distortion.

    The images are undistorted once, here; dense reconstruction then uses the pinhole projection alone. Iteration,
    ``len`` and `own` leave out the views of keyframes that were culled since; the next `append` removes them.

    Args:
        camera: Camera of the frames.
        stride: Every n-th row and column is stored.

    Attributes:
        stride: Stride of the views, pixels of the frames.
        camera: Camera of the views, without distortion.
        rays: Viewing rays at unit depth, float32, shape :math:`(h, w, 3)`. The ray of a pixel is the exact ray of the
            pixel of the frame from which it was sampled.

    Raises:
        ConfigError: If the stride is not at least 1.
    """

    _STATE = ("_views",)

    def __init__(self, camera: PinholeCamera, stride: int) -> None:
        if stride < 1:
            raise ConfigError(f"stride is {stride}; give a number of pixels of at least 1")
        self.stride = stride
        self._size = camera.height, camera.width
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
        return sum(1 for _ in self)

    def __iter__(self) -> Iterator[StaticView]:
        return (view for view in self._views if not view.keyframe.is_culled)

    @property
    def own(self) -> list[StaticView]:
        """Views of this run, without those of a known map."""
        return [view for view in self if not view.keyframe.is_from_earlier_run]

    def connected(self) -> StaticViews:
        """Return these views without those of disconnected keyframes, whose place in the map is only a guess."""
        views = copy(self)
        views._views = [view for view in self if not view.keyframe.is_disconnected]
        return views

    def add(
        self,
        keyframe: Keyframe,
        image: Tensor,
        depth: Tensor,
        static: Tensor,
        depth_delay: float = 0.0,
        T_dc: Tensor | None = None,
    ) -> None:
        """Store the static pixels of a keyframe as a view.

        Args:
            keyframe: Keyframe from whose frame the images are.
            image: RGB image, uint8, shape :math:`(3, H, W)`.
            depth: Depth image, metres, shape :math:`(1, H, W)`.
            static: Mask of static pixels, bool, shape :math:`(H, W)`.
            depth_delay: Time of the depth image minus time of the colour image by their timestamps, seconds.
            T_dc: Motion of the camera from the time of the colour image to that of the depth image, see `FrameResult`,
                float64, shape :math:`(4, 4)`; None for a camera at rest.

        Raises:
            InputError: If ``static`` is not bool.
        """
        check_masks(static=static)
        check_shape("image", image, 3, *self._size)
        check_shape("depth", depth, 1, *self._size)
        check_shape("static", static, *self._size)
        T_dc = torch.eye(4, dtype=torch.float64) if T_dc is None else T_dc
        units = (depth[0, self._v, self._u] / STORED_UNIT).round()
        keep = self._inside & static[self._v, self._u] & (units > 0) & (units < 2**16)
        units = torch.where(keep, units, 0).to(torch.uint16)
        self.append(StaticView(keyframe, units, image[:, self._v, self._u], T_dc, depth_delay))

    def append(self, view: StaticView) -> None:
        """Append a view, and remove the views of keyframes that were culled.

        Args:
            view: View of this camera.
        """
        self._views = [*self, view]
