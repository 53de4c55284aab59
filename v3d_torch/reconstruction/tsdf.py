"""Truncated signed distances to the surfaces that keyframes saw, in blocks of voxels around them.

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996; blocks as in
Niessner et al., "Real-time 3D Reconstruction at Scale using Voxel Hashing", 2013. A voxel stands for the point at
``index * voxel size`` of the world.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import DenseMapConfig
from v3d_torch.geometry.camera import back_project
from v3d_torch.mapping.static_views import StaticView, StaticViews

BLOCK = 8
"""Voxels along a side of a block: less would be few for a tensor, more would reach far from the surface."""

_HALF = 2**20
"""Blocks to either side of the world's origin that can be numbered in 63 bits: 160 km at 2 cm."""

_TOGETHER = 1024
"""Blocks that are projected into a view at a time, so that half a million voxels stay in the cache."""


def surface_blocks(views: StaticViews, config: DenseMapConfig) -> Tensor:
    """Blocks that hold something of the surfaces seen, or lie within the truncation before and behind them.

    Returns:
        Block coordinates, each once, in order, int64, shape :math:`(N, 3)`.
    """
    found = [torch.zeros(0, dtype=torch.int64)]
    for view in views:
        depth = view.depth
        seen = (depth > 0) & (depth <= config.max_depth)
        points = back_project(depth[None, None], views.rays)[0][seen].to(torch.float64)
        along = config.mesh.truncation * points / points.norm(dim=1, keepdim=True)
        points = torch.cat([points - along, points, points + along]) @ view.T_wc[:3, :3].T + view.T_wc[:3, 3]
        x, y, z = ((points / (BLOCK * config.mesh.voxel_size)).floor().to(torch.int64) + _HALF).unbind(dim=1)
        found.append(((x * 2 * _HALF + y) * 2 * _HALF + z).unique())
    keys = torch.cat(found).unique()
    places = [keys.div(4 * _HALF**2, rounding_mode="floor"), keys.div(2 * _HALF, rounding_mode="floor"), keys]
    return torch.stack(places, dim=1) % (2 * _HALF) - _HALF


def integrate(blocks: Tensor, views: StaticViews, config: DenseMapConfig) -> tuple[Tensor, Tensor]:
    """Mean signed distance, over all views, of the voxels of some blocks.

    Before a surface every view counts, however far before: one that looks through a ghost wipes it out. Behind, only
    within the truncation, as nobody knows how thick things are.

    Args:
        blocks: block coordinates, int64, shape :math:`(N, 3)`.
        views: of keyframes.
        config: of the mesh.

    Returns:
        Distances along the camera's axis in units of the truncation, in [-1, 1], positive in free space, 1 where
        nothing is known; and the weights of all measurements, 0 where there is none. Both float32, of shape
        :math:`(N, 8, 8, 8)`, in the order of x, y and z.
    """
    steps = torch.arange(BLOCK, dtype=torch.float64) * config.mesh.voxel_size
    offsets = torch.cartesian_prod(steps, steps, steps)  # of a block's voxels, (512, 3)
    corners = blocks.to(torch.float64) * (BLOCK * config.mesh.voxel_size)
    sums, weights = torch.zeros(2, len(blocks), len(offsets))
    for view in views:
        for rows in _in_field(corners, view, views, config).split(_TOGETHER):
            distance, weight = _measure(corners[rows], offsets, view, views, config)
            sums[rows] += weight * distance
            weights[rows] += weight
    distances = torch.where(weights > 0, sums / weights, 1.0)
    shape = (len(blocks), BLOCK, BLOCK, BLOCK)
    return distances.reshape(shape), weights.reshape(shape)


def _in_field(corners: Tensor, view: StaticView, views: StaticViews, config: DenseMapConfig) -> Tensor:
    """Rows of the blocks, given by their corners, of which a view may see something."""
    side = (BLOCK - 1) * config.mesh.voxel_size
    radius = 0.5 * 3**0.5 * side
    x, y, z = ((corners + 0.5 * side) @ view.T_cw[:3, :3].T + view.T_cw[:3, 3]).unbind(dim=1)
    camera = views.camera
    seen = z > -radius
    for position, focal, first, last in (
        (x, camera.fx, -0.5 - camera.cx, camera.width - 0.5 - camera.cx),
        (y, camera.fy, -0.5 - camera.cy, camera.height - 0.5 - camera.cy),
    ):  # distances to the four sides of the field's pyramid
        seen &= focal * position - first * z >= -radius * (focal**2 + first**2) ** 0.5
        seen &= last * z - focal * position >= -radius * (focal**2 + last**2) ** 0.5
    return torch.nonzero(seen)[:, 0]


def _measure(
    corners: Tensor, offsets: Tensor, view: StaticView, views: StaticViews, config: DenseMapConfig
) -> tuple[Tensor, Tensor]:
    """What a view says of the voxels of blocks: distances and weights, float32, shape (n, 512)."""
    R_cw, t_cw = view.T_cw[:3, :3], view.T_cw[:3, 3]
    base, step = (corners @ R_cw.T + t_cw).to(torch.float32), (offsets @ R_cw.T).to(torch.float32)
    x, y, z = (base[:, None, axis] + step[:, axis] for axis in range(3))
    camera = views.camera
    inverse = 1 / z.clamp(min=config.mesh.voxel_size)
    u = (camera.fx * x * inverse + camera.cx).round()
    v = (camera.fy * y * inverse + camera.cy).round()
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height) & (z > config.mesh.voxel_size)
    pixel = torch.where(inside, v * camera.width + u, 0).to(torch.int64)
    depth = view.depth.flatten()[pixel]
    distance = (depth - z) / config.mesh.truncation
    known = inside & (depth > 0) & (distance > -1)
    # Depth errs by z^2, poses by the same everywhere: the weight is between the z^-4 of the one and 1 of the other.
    return distance.clamp(max=1.0), torch.where(known, inverse.square(), 0.0)
