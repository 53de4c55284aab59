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
from v3d_torch.kernels import surface_centroids as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.objects.depth_view import DepthView


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
        T_wd = invert(view.T_dw).numpy()
        means = _surface_means(view.depth[0], masks, self._rays, self._config)
        return [None if each is None else torch.from_numpy(T_wd[:3, :3] @ each + T_wd[:3, 3]) for each in means]


def _surface_means_compiled(
    depth: Tensor, masks: Sequence[Tensor], rays: NDArray[np.float32], config: CloudConfig
) -> list[NDArray[np.float64] | None]:
    if depth.dtype != torch.float32:
        return NotImplemented
    image, means = to_array(depth), list[NDArray[np.float64] | None]()
    for mask in masks:
        mean, count = kernels.surface_mean(image, to_array(mask), rays, config.stride, np.float32(config.max_depth))
        if count > 0 and np.isnan(mean[0]):
            return NotImplemented
        means.append(mean if count > 0 else None)
    return means


@compiled_by(_surface_means_compiled)
def _surface_means(
    depth: Tensor, masks: Sequence[Tensor], rays: NDArray[np.float32], config: CloudConfig
) -> list[NDArray[np.float64] | None]:
    """Return the mean of the voxels of the surface in each mask, camera frame, (3,); None for a mask without depth.

    Args:
        depth: Depth, metres, (H, W).
        masks: Masks, each of shape (H, W).
        rays: Ray of every n-th pixel at unit depth, (R, 3).
        config: Spacing of the pixels, and maximum depth.
    """
    every = slice(None, None, config.stride)
    z = depth.numpy()[every, every]
    is_known = (z > 0) & (z <= config.max_depth)
    pixels = [np.flatnonzero(mask.numpy()[every, every] & is_known) for mask in masks]
    return [_mean_of_voxels(_surface(rays[each], z.ravel()[each])) if len(each) else None for each in pixels]


def _surface(rays: NDArray[np.float32], depth: NDArray[np.float32]) -> Tensor:
    """Return the points (P, 3) of the rays (R, 3) whose depth (R,) is near their median depth."""
    middle = len(depth) // 2
    near = np.abs(depth - np.partition(depth, middle)[middle]) < kernels.MAX_DEPTH_OFFSET
    return torch.from_numpy(rays[near] * depth[near, None])


def _mean_of_voxels(surface: Tensor) -> NDArray[np.float64]:
    """Return the mean of the voxels of a surface (P, 3), shape (3,)."""
    return np.asarray(pool_cloud(surface, kernels.VOXEL_SIZE).means[0].numpy().mean(axis=0, dtype=np.float64))
