"""Static surfaces in the views of the last seconds, for places that people occlude for a short time.

The free-space check compares a frame with one earlier frame for each time span. A place that a person occluded in all
of them is unknown: the floor before the feet of a person who walks towards the camera seems as new as the person.
Views of the last seconds often show this place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.kernels import static_surfaces as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.objects.depth_view import DepthView, StoredView
from v3d_torch.objects.free_space_check import limits, observe_free_space
from v3d_torch.objects.stored_views import StoredViews
from v3d_torch.types import STAMP_TOLERANCE

_TIME_SPAN = 3.0
"""Age of the oldest view, seconds: a person who walks by hides a place for less."""

_INTERVAL = 0.5
"""Time between two views, seconds: a walking person moves by about the width of a person."""


def _find_compiled(
    view: DepthView,
    pixels: Tensor,
    stride: int,
    earlier: Sequence[StoredView],
    camera: PinholeCamera,
    config: FreeSpaceConfig,
) -> Tensor:
    depth, rays, T_wd = to_array(view.depth[0]), to_array(camera.rays), to_array(invert(view.T_dw))
    coarse = depth[::stride, ::stride]
    is_candidate = pixels.numpy() & (coarse > config.min_depth) & (coarse <= config.max_depth)
    unknown, static = np.flatnonzero(is_candidate), np.zeros(coarse.shape, np.bool_)
    for each in reversed(earlier):
        pose, nearest_depth = to_array(each.T_dw), to_array(each.nearest_depth)
        observer = pose, nearest_depth, camera.intrinsics, camera.bounds, limits(config)
        unknown = kernels.find_static(depth, stride, rays, T_wd, *observer, unknown, static)
    return torch.from_numpy(static)


@compiled_by(_find_compiled)
def _find(
    view: DepthView,
    pixels: Tensor,
    stride: int,
    earlier: Sequence[StoredView],
    camera: PinholeCamera,
    config: FreeSpaceConfig,
) -> Tensor:
    """Find the pixels whose surface is a static one of an earlier view, see `StaticSurfaces.find`.

    Args:
        view: Current view.
        pixels: Pixels to check, bool, shape (h, w).
        stride: Step between the pixels, pixels.
        earlier: Earlier views, oldest first.
        camera: Camera of all views.
        config: Range of depths and tolerances.
    """
    # NumPy is faster here than torch.
    rows, columns = np.nonzero(pixels.numpy())
    source = stride * rows, stride * columns
    depth = view.depth[0].numpy()[source].astype(np.float64)
    T_wd = invert(view.T_dw).numpy()
    points = (camera.rays.numpy()[source] * depth[:, None]) @ T_wd[:3, :3].T + T_wd[:3, 3]
    found = np.zeros(len(points), np.bool_)
    unknown = np.flatnonzero((depth > config.min_depth) & (depth <= config.max_depth))
    for each in reversed(earlier):
        free = observe_free_space(torch.from_numpy(points[unknown]), each, camera, config).numpy()
        found[unknown[free == 0]] = True
        unknown = unknown[np.isnan(free)]
    static = torch.zeros_like(pixels)
    static.numpy()[rows, columns] = found
    return static


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
        return _find(view, pixels, stride, self._views, self._camera, self._config)

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
