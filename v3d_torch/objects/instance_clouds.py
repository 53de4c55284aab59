"""Instances to clean clouds: back-project, voxel pool, DBSCAN, keep the largest clusters (paper, Sec. III-B.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.objects.dbscan import dbscan
from v3d_torch.objects.largest_clusters import largest_clusters
from v3d_torch.objects.mask_ops import upsample_nearest
from v3d_torch.types import Instances


@dataclass(frozen=True)
class InstanceClouds:
    """A cloud per instance, padded to one length.

    Attributes:
        points: voxel means in the camera frame, metres, float32, shape :math:`(N, P, 3)`.
        valid: which are points and not padding, bool, shape :math:`(N, P)`.
        centroid: mean of the points, float32, shape :math:`(N, 3)`; nan where a cloud has too few points.
        own: pixels of each mask whose point is in the cloud, bool, shape :math:`(N, H, W)`.
    """

    points: Tensor
    valid: Tensor
    centroid: Tensor
    cloud_pixels: Tensor

    def __len__(self) -> int:
        return self.points.shape[0]


class InstanceBackProjector:
    """Lifts instances into 3D and rejects what does not belong to them.

    Args:
        config: resolution and clustering.
        camera: back-projects the depth.
    """

    def __init__(self, config: CloudConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._rays = camera.rays[:: config.stride, :: config.stride].reshape(-1, 3).numpy()

    def __call__(self, depth: Tensor, instances: Instances) -> InstanceClouds:
        """Lift all instances of a frame at once.

        Args:
            depth: re-estimated, metres, float32, shape :math:`(1, H, W)`; 0 = none.
            instances: of the same image.
        """
        config = self._config
        points, valid, pixel = self._gather(depth, instances)
        points, valid, _, owner = voxel_pool(points, valid, config.voxel_size)
        labels = dbscan(points, valid, config.eps, config.min_samples)
        # The paper keeps as many blobs as there are instances; here each instance has its own cloud and keeps one.
        valid = largest_clusters(labels, valid, 1)
        count = valid.sum(dim=1)
        centroid = (points * valid[..., None]).sum(dim=1) / count.clamp(min=1)[:, None]
        centroid[count < config.min_points] = torch.nan
        return InstanceClouds(points, valid, centroid, self._own(instances.masks, valid, owner, pixel))

    def _own(self, masks: Tensor, valid: Tensor, owner: Tensor, pixel: Tensor) -> Tensor:
        """Pixels of each mask whose point is in a voxel that stayed, bool, :math:`(N, H, W)`."""
        step = self._config.stride
        own = torch.zeros_like(masks[:, ::step, ::step])
        instance, point = torch.nonzero(owner >= 0, as_tuple=True)
        own.flatten(1)[instance, pixel[instance, point]] = valid[instance, owner[instance, point]]
        return upsample_nearest(own.numpy(), step, masks.shape[-2:]) & masks

    def _gather(self, depth: Tensor, instances: Instances) -> tuple[Tensor, Tensor, Tensor]:
        """Every n-th masked pixel with depth as a padded set of points.

        Returns:
            Points :math:`(N, P, 3)`, which exist :math:`(N, P)`, and their pixels, numbered row by row, :math:`(N, P)`.
        """
        step = self._config.stride
        z = depth[0, ::step, ::step].numpy()
        masks = instances.masks.numpy()[:, ::step, ::step] & ((z > 0) & (z <= self._config.max_depth))
        count = np.count_nonzero(masks, axis=(1, 2))
        valid = np.arange(max(count.max(initial=0), 1)) < count[:, None]
        pixel = np.flatnonzero(masks) % z.size
        pixels, points = np.zeros(valid.shape, np.int64), np.zeros((*valid.shape, 3), np.float32)
        pixels[valid], points[valid] = pixel, self._rays[pixel] * z.ravel()[pixel, None]
        return torch.from_numpy(points), torch.from_numpy(valid), torch.from_numpy(pixels)
