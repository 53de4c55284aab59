"""Truncated signed distance function (TSDF) of the static surfaces, in sparse blocks of voxels.

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996; sparse blocks as
in Niessner et al., "Real-time 3D Reconstruction at Scale using Voxel Hashing", 2013.

Convention: a voxel is a sample at the point ``index * voxel size`` of the world frame.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from v3d_torch.config import DenseMapConfig
from v3d_torch.geometry.camera import PinholeCamera, back_project
from v3d_torch.geometry.cell_keys import cell_keys, cells_of_keys
from v3d_torch.geometry.frustum import are_in_frustum
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.mapping.static_views import StaticView, StaticViews

BLOCK = 8
"""Number of voxels along a side of a block: large enough for tensor operations, small enough to follow the surface."""

_BLOCKS_PER_STEP = 1024
"""Number of blocks that are projected into a view at once; half a million voxels fit into the processor's cache."""


def surface_blocks(views: StaticViews, config: DenseMapConfig) -> Tensor:
    """Find the blocks within the truncation distance of the observed surfaces.

    Args:
        views: Static views of the keyframes.
        config: Configuration of the dense map and the mesh.

    Returns:
        Unique block coordinates in ascending order, int64, shape :math:`(N, 3)`.
    """
    side = BLOCK * config.mesh.voxel_size
    # Steps along a ray of at most one block: a block is missed only where a ray cuts one of its edges.
    steps = torch.linspace(-1, 1, 2 * math.ceil(config.mesh.truncation / side) + 1, dtype=torch.float64)
    found = [torch.zeros(0, dtype=torch.int64)]
    for view in views:
        depth = view.depth
        valid = (depth > 0) & (depth <= config.max_depth)
        points = back_project(depth[None, None], views.rays)[0][valid].to(torch.float64)
        offset = config.mesh.truncation * points / points.norm(dim=1, keepdim=True)
        points = transform_points(view.T_wd, torch.cat([points + step * offset for step in steps]))
        blocks = (points / side).floor().to(torch.int64)
        found.append(cell_keys(blocks).unique())
    return cells_of_keys(torch.cat(found).unique())


def integrate(blocks: Tensor, views: StaticViews, config: DenseMapConfig) -> tuple[Tensor, Tensor]:
    """Mean truncated signed distance of the voxels of blocks, over all views.

    Every view counts for voxels in front of its surface, at any distance: observed free space removes objects that were
    present in few views. Behind its surface, a view counts only within the truncation distance, because the thickness
    of objects is unknown.

    Args:
        blocks: Block coordinates, int64, shape :math:`(N, 3)`.
        views: Static views of the keyframes.
        config: Configuration of the dense map and the mesh.

    Returns:
        Distances along the optical axis in units of the truncation distance, in [-1, 1], positive in free space, 1
        without any measurement; and the sum of the weights of all measurements, 0 without any. Both float32, shape
        :math:`(N, 8, 8, 8)`, in the order x, y, z.
    """
    steps = torch.arange(BLOCK, dtype=torch.float64) * config.mesh.voxel_size
    offsets = torch.cartesian_prod(steps, steps, steps)  # of the voxels in a block, (512, 3)
    corners = blocks.to(torch.float64) * (BLOCK * config.mesh.voxel_size)
    to_centre = offsets[-1] / 2
    radius = float(to_centre.norm())
    sums, weights = torch.zeros(2, len(blocks), len(offsets))
    for view in views:
        in_view = are_in_frustum(transform_points(view.T_dw, corners + to_centre), radius, views.camera)
        for rows in torch.nonzero(in_view)[:, 0].split(_BLOCKS_PER_STEP):
            distance, weight = _measure(corners[rows], offsets, view, views.camera, config)
            sums[rows] += weight * distance
            weights[rows] += weight
    distances = torch.where(weights > 0, sums / weights, 1.0)
    shape = (len(blocks), BLOCK, BLOCK, BLOCK)
    return distances.reshape(shape), weights.reshape(shape)


def _measure(
    corners: Tensor, offsets: Tensor, view: StaticView, camera: PinholeCamera, config: DenseMapConfig
) -> tuple[Tensor, Tensor]:
    """Truncated distances and weights of the voxels of blocks in one view, float32, shape (n, 512) each."""
    base = transform_points(view.T_dw, corners).to(torch.float32)
    step = (offsets @ view.T_dw[:3, :3].T).to(torch.float32)
    x, y, z = (base[:, None, axis] + step[:, axis] for axis in range(3))
    inverse_z = 1 / z.clamp(min=config.mesh.voxel_size)
    u = (camera.fx * x * inverse_z + camera.cx).round()
    v = (camera.fy * y * inverse_z + camera.cy).round()
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height) & (z > config.mesh.voxel_size)
    pixel = torch.where(inside, v * camera.width + u, 0).to(torch.int64)
    depth = view.depth.flatten()[pixel]
    distance = (depth - z) / config.mesh.truncation
    valid = inside & (depth > 0) & (distance > -1)
    # The depth error grows with z^2, which gives the weight z^-4; the pose error is constant, which gives the weight 1.
    # The weight z^-2 is between the two.
    return distance.clamp(max=1.0), torch.where(valid, inverse_z.square(), 0.0)
