"""Centroids of the surfaces that masks show: the positions of objects in the results of a frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.geometry.voxel import pool_cloud
from v3d_torch.objects.depth_view import DepthView

_VOXEL_SIZE = 0.05
"""Side of the voxels over which a centroid averages, metres. They are larger than the distances between the points, so
that near and far parts of a surface count the same."""

_MAX_DEPTH_OFFSET = 0.6
"""Pixels whose depth differs more from the median of their mask do not show the object, metres: about the length of an
arm."""


class SurfaceCentroids:
    """Centroids of the surfaces in masks.

    A mean over pixels is nearer to the near parts of an object, of which more pixels are seen. Here each voxel of the
    surface has the same weight.

    Args:
        config: Spacing of the pixels, and maximum depth.
        camera: Camera of the depth images.
    """

    def __init__(self, config: CloudConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._rays = camera.rays[:: config.stride, :: config.stride].reshape(-1, 3).numpy()

    def __call__(self, view: DepthView, masks: Sequence[Tensor]) -> list[Tensor | None]:
        """Compute the centroid of the surface in each mask.

        Args:
            view: Depth and pose of the frame.
            masks: Masks, bool, each of shape :math:`(H, W)`.

        Returns:
            Centroids, world frame, metres, float64, each of shape :math:`(3,)`; None for a mask without depth.
        """
        stride, T_wd = self._config.stride, invert(view.T_dw).numpy()
        depth = np.ascontiguousarray(view.depth.numpy()[0, ::stride, ::stride])
        is_known = (depth > 0) & (depth <= self._config.max_depth)
        pixels = [np.flatnonzero(mask.numpy()[::stride, ::stride] & is_known) for mask in masks]
        surfaces = [self._surface(each, depth.take(each)) for each in pixels]
        return [
            torch.from_numpy(T_wd[:3, :3] @ _mean_of_voxels(each) + T_wd[:3, 3]) if len(each) else None
            for each in surfaces
        ]

    def _surface(self, pixels: NDArray[np.intp], depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the points (P, 3) of the pixels (R,) whose depth (R,) is near their median depth."""
        # NumPy is faster here than torch: a frame has a few small surfaces.
        if not len(depth):
            return np.zeros((0, 3), np.float32)
        middle = len(depth) // 2
        near = np.abs(depth - np.partition(depth, middle)[middle]) < _MAX_DEPTH_OFFSET
        return self._rays.take(pixels[near], axis=0) * depth[near][:, None]


def _mean_of_voxels(surface: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mean of the voxels of a surface (P, 3), shape (3,)."""
    voxels = pool_cloud(torch.from_numpy(surface), _VOXEL_SIZE)
    return np.asarray(voxels.means[0].numpy().mean(axis=0, dtype=np.float64))
