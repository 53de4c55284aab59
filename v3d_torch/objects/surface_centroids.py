"""Centroids of the surfaces that masks show: the positions of objects in the results of a frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, transform_points
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.mask_points import back_project_masks

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
        if not masks:
            return []
        points, valid, _ = back_project_masks(view.depth[0], torch.stack(list(masks)), self._rays, self._config)
        z = points[..., 2]
        median = z.masked_fill(~valid, torch.nan).nanmedian(dim=1, keepdim=True).values
        means, is_voxel, *_ = voxel_pool(points, valid & ((z - median).abs() < _MAX_DEPTH_OFFSET), _VOXEL_SIZE)
        count = is_voxel.sum(dim=1)
        centroids = means.to(torch.float64).sum(dim=1) / count[:, None]
        in_world = transform_points(invert(view.T_dw), centroids)
        return [each if known else None for each, known in zip(in_world, (count > 0).tolist(), strict=True)]
