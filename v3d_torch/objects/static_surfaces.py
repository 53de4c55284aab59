"""Static surfaces in the views of the last seconds, for places that people occlude for a short time.

The free-space check compares a frame with one earlier frame for each time span. A place that a person occluded in all
of them is unknown: the floor before the feet of a person who walks towards the camera seems as new as the person.
Views of the last seconds often show this place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.depth_view import DepthView, StoredView
from v3d_torch.objects.free_space_check import observe_free_space
from v3d_torch.objects.stored_views import StoredViews
from v3d_torch.types import STAMP_TOLERANCE

_TIME_SPAN = 3.0
"""Age of the oldest view, seconds: a person who walks by hides a place for less."""

_INTERVAL = 0.5
"""Time between two views, seconds: a walking person moves by about the width of a person."""


class StaticSurfaces(StoredViews):
    """Views of the last seconds that contain the static scene only.

    Args:
        config: Range of depths and tolerances; without the free-space check, no surface is known.
        camera: Camera of all views.
    """

    def __init__(self, config: FreeSpaceConfig, camera: PinholeCamera) -> None:
        super().__init__()
        self._config = config
        self._camera = camera

    def find(self, view: DepthView, pixels: Tensor, stride: int) -> Tensor:
        """Find the pixels whose surface is a static one of an earlier view.

        The newest view that observes the place of a surface decides.

        Args:
            view: Current view.
            pixels: Pixels to check, bool, every ``stride``-th pixel, shape :math:`(h, w)`.
            stride: Step between the pixels, pixels.

        Returns:
            Bool, shape :math:`(h, w)`.
        """
        # NumPy is faster here than torch.
        rows, columns = np.nonzero(pixels.numpy())
        source = stride * rows, stride * columns
        depth = view.depth[0].numpy()[source].astype(np.float64)
        T_wd = invert(view.T_dw).numpy()
        points = (self._camera.rays.numpy()[source] * depth[:, None]) @ T_wd[:3, :3].T + T_wd[:3, 3]
        found = np.zeros(len(points), np.bool_)
        unknown = np.flatnonzero((depth > self._config.min_depth) & (depth <= self._config.max_depth))
        for earlier in reversed(self._views):
            if not unknown.size:
                break
            of_unknown = torch.from_numpy(points[unknown])
            free = observe_free_space(of_unknown, earlier, self._camera, self._config).numpy()
            found[unknown[free == 0]] = True
            unknown = unknown[np.isnan(free)]
        static = torch.zeros_like(pixels)
        static.numpy()[rows, columns] = found
        return static

    def add_view(self, view: DepthView, T_dw: Tensor, map_mask: Tensor) -> None:
        """Store the static part of a view if the last one is old enough, and drop views that are too old.

        Args:
            view: View, newer than all stored ones.
            T_dw: World-to-camera pose at the time of the depth image, float64, shape :math:`(4, 4)`.
            map_mask: Map mask of the frame, see `FrameObjects`, bool, shape :math:`(H, W)`.
        """
        is_early = bool(self._views) and view.stamp < self._views[-1].stamp + _INTERVAL - STAMP_TOLERANCE
        if is_early or not self._config.enabled:
            return
        # Remove the depth of people first: otherwise the minimum around a pixel beside a person is that of the person.
        nearest_depth = replace(view, depth=view.depth * map_mask).nearest_depth
        self._store(StoredView(view.stamp, nearest_depth, T_dw), _TIME_SPAN)
