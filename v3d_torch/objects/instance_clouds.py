"""Clean point clouds of instances: back-projection, voxel pooling, DBSCAN, selection of clusters (paper, Sec. III-B.2).

The largest cluster is the object. Something in front can divide the object, such as a box that a person carries: other
large clusters of nearly the same depth are parts of it. The background in a coarse mask is farther away, or small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.kernels import instance_clouds as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.kernels.dbscan import MAX_CELLS
from v3d_torch.objects.dbscan import dbscan
from v3d_torch.objects.largest_clusters import largest_clusters
from v3d_torch.objects.resampling import upsample_nearest
from v3d_torch.types import Instances


@dataclass(frozen=True)
class InstanceClouds:
    """Point clouds of N instances, padded to one length.

    Attributes:
        points: Voxel means of the masked pixels, outliers included, camera frame, metres, float32, shape
            :math:`(N, P, 3)`.
        valid: Mask of the points of the object, bool, shape :math:`(N, P)`; False for outliers and padding.
        centroid: Mean of the points, float32, shape :math:`(N, 3)`; NaN if a cloud has too few points.
        cloud_pixels: Pixels of each mask whose point belongs to the cloud, bool, shape :math:`(N, H, W)`.
    """

    points: Tensor
    valid: Tensor
    centroid: Tensor
    cloud_pixels: Tensor

    def __len__(self) -> int:
        return self.points.shape[0]


class InstanceBackProjector:
    """Back-projection of instances into 3D with outlier rejection.

    Args:
        config: Resolution and clustering.
        camera: Camera of the depth images.
    """

    def __init__(self, config: CloudConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._rays = camera.rays[:: config.stride, :: config.stride].reshape(-1, 3).contiguous().numpy()

    def __call__(self, depth: Tensor, instances: Instances) -> InstanceClouds:
        """Compute the clouds of all instances of a frame at once.

        Args:
            depth: Smoothed depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
            instances: Instances of the same image.

        Returns:
            Clouds in the order of the instances.
        """
        return _compute_clouds(depth[0], instances.masks, self._rays, self._config)


def _compute_clouds_compiled(
    depth: Tensor, masks: Tensor, rays: NDArray[np.float32], config: CloudConfig
) -> InstanceClouds:
    # No cloud is wider than this; the kernels can number only this many cells.
    max_width = 2 * config.max_depth * float(np.maximum(np.abs(rays).max(), 1.0))
    is_numbered = max_width <= MAX_CELLS / 2 * min(config.eps, config.voxel_size)  # false if a ray is NaN
    if depth.dtype != torch.float32 or not is_numbered:
        return NotImplemented
    parameters = np.float32(config.max_depth), np.float32(config.voxel_size), config.eps, config.min_samples
    z, cloud_pixels = to_array(depth), np.zeros(masks.shape, np.bool_)
    clouds = [
        kernels.instance_cloud(z, mask, rays, config.stride, *parameters, pixels)
        for mask, pixels in zip(to_array(masks), cloud_pixels, strict=True)
    ]
    shape = len(clouds), max((len(points) for points, _ in clouds), default=0)
    points, valid = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.bool_)
    for i, (cloud, selected) in enumerate(clouds):
        points[i, : len(cloud)], valid[i, : len(cloud)] = cloud, selected
    pixels = torch.from_numpy(cloud_pixels)
    return _with_centroids(torch.from_numpy(points), torch.from_numpy(valid), pixels, config.min_points)


@compiled_by(_compute_clouds_compiled)
def _compute_clouds(depth: Tensor, masks: Tensor, rays: NDArray[np.float32], config: CloudConfig) -> InstanceClouds:
    """Compute the clouds of masks (N, H, W) of a depth image (H, W), with the rays (R, 3) of every n-th pixel."""
    points, valid, pixel = _back_project(depth, masks, rays, config)
    points, valid, _, voxel = voxel_pool(points, valid, config.voxel_size)
    labels = dbscan(points, valid, config.eps, config.min_samples)
    # The paper keeps as many clusters as there are instances. Here each instance has its own cloud.
    valid = _select_object(points, labels, valid)
    return _with_centroids(points, valid, _cloud_pixels(masks, valid, voxel, pixel, config.stride), config.min_points)


def _select_object(points: Tensor, labels: Tensor, valid: Tensor) -> Tensor:
    """Select the points (N, P) of the largest cluster of each cloud and of the other parts of the object."""
    largest = largest_clusters(labels, valid, 1)
    if labels.numel() == 0:
        return largest
    clustered, cluster = valid & (labels >= 0), labels.clamp(min=0)
    nothing = torch.zeros(labels.shape, dtype=torch.float64)
    size = nothing.scatter_add(1, cluster, clustered.to(torch.float64))
    depth = nothing.scatter_add(1, cluster, points[..., 2] * clustered.to(torch.float64)) / size
    of_largest = torch.where(largest, cluster, 0).amax(dim=1, keepdim=True)
    is_part = (depth - depth.gather(1, of_largest)).abs() <= kernels.MAX_PART_OFFSET
    is_part &= size >= kernels.MIN_PART_SIZE * size.gather(1, of_largest)
    return clustered & is_part.gather(1, cluster)


def _with_centroids(points: Tensor, valid: Tensor, cloud_pixels: Tensor, min_points: int) -> InstanceClouds:
    count = valid.sum(dim=1)
    centroid = (points * valid[..., None]).sum(dim=1) / count.clamp(min=1)[:, None]
    centroid[count < min_points] = torch.nan
    return InstanceClouds(points, valid, centroid, cloud_pixels)


def _cloud_pixels(masks: Tensor, valid: Tensor, voxel: Tensor, pixel: Tensor, stride: int) -> Tensor:
    """Return the pixels of each mask whose point lies in a valid voxel, bool, shape (N, H, W)."""
    cells = torch.zeros_like(masks[:, ::stride, ::stride])
    instance, point = torch.nonzero(voxel >= 0, as_tuple=True)
    cells.flatten(1)[instance, pixel[instance, point]] = valid[instance, voxel[instance, point]]
    return upsample_nearest(cells.numpy(), stride, masks.shape[-2:]) & masks


def _back_project(
    depth: Tensor, masks: Tensor, rays: NDArray[np.float32], config: CloudConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Back-project every n-th masked pixel with depth.

    Returns:
        Points :math:`(N, P, 3)`, their validity :math:`(N, P)`, and their row-major pixel indices :math:`(N, P)`.
    """
    stride = config.stride
    z = depth[::stride, ::stride].numpy()
    selected = masks.numpy()[:, ::stride, ::stride] & ((z > 0) & (z <= config.max_depth))
    count = np.count_nonzero(selected, axis=(1, 2))
    valid = np.arange(max(count.max(initial=0), 1)) < count[:, None]
    pixel = np.flatnonzero(selected) % z.size
    pixels, points = np.zeros(valid.shape, np.int64), np.zeros((*valid.shape, 3), np.float32)
    pixels[valid], points[valid] = pixel, rays[pixel] * z.ravel()[pixel, None]
    return torch.from_numpy(points), torch.from_numpy(valid), torch.from_numpy(pixels)
