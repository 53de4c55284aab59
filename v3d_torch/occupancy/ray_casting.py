"""Ray casting of depth images in a voxel grid: voxels that are observed as free, and voxels that are hit."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from v3d_torch.geometry.argument_checks import check_shape
from v3d_torch.geometry.cell_keys import cell_keys, cells_of_keys
from v3d_torch.kernels import ray_casting as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.kernels.voxel_blocks import BITS, FREE, HIT, SIDE, VOLUME


class Observations(NamedTuple):
    """Voxels that one view observes.

    Attributes:
        blocks: Coordinates of the blocks with observed voxels, ascending, int64, shape :math:`(B, 3)`.
        marks: 0 for a voxel that is not observed, 1 for a free voxel, 2 for a voxel that is hit, uint8,
            shape :math:`(B, 4096)` in the order x, y, z.
    """

    blocks: Tensor
    marks: Tensor


def _observe_compiled(
    depth: Tensor, static: Tensor, rays: Tensor, T_wc: Tensor, voxel_size: float, max_depth: float, tolerance: float
) -> Observations:
    if depth.dtype != torch.float32 or rays.dtype != torch.float32 or T_wc.dtype != torch.float64:
        return NotImplemented
    if static.shape != depth.shape or rays.shape != (*depth.shape, 3) or T_wc.shape != (4, 4):
        return NotImplemented
    reach = math.ceil(max_depth * float(rays.square().sum(dim=-1).max().sqrt()) / (SIDE * voxel_size)) + 1
    samples = to_array(depth), to_array(static), to_array(rays)
    blocks, marks = kernels.observe_voxels(*samples, to_array(T_wc), voxel_size, max_depth, tolerance, reach)
    coordinates = torch.from_numpy(blocks)
    order = cell_keys(coordinates).argsort()
    return Observations(coordinates[order], torch.from_numpy(marks)[order])


@compiled_by(_observe_compiled)
def observe_voxels(
    depth: Tensor, static: Tensor, rays: Tensor, T_wc: Tensor, voxel_size: float, max_depth: float, tolerance: float
) -> Observations:
    """Find the voxels that a view observes as free or hits (Hornung et al., "OctoMap", Autonomous Robots 2013).

    A voxel is free if a ray leaves it before the surface, by at least half a voxel plus the depth error. The depth of
    the surface is the minimum over the sample of the ray and its eight neighbours, so that rays at grazing incidence do
    not remove a floor, and rays beside the edge of an object do not remove the object. A voxel that contains a static
    sample is hit, even if other rays pass through it.

    Args:
        depth: Depth of samples, metres, float32, shape :math:`(h, w)`; 0, NaN or infinite = no measurement.
        static: Mask of samples on static surfaces, bool, shape :math:`(h, w)`. Other samples hit no voxel; they only
            show that the space in front of them is free.
        rays: Viewing ray of each sample at unit depth, float32, shape :math:`(h, w, 3)`.
        T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
        voxel_size: Side of a voxel, metres.
        max_depth: Depth beyond which nothing is observed, metres.
        tolerance: Depth error divided by the squared depth, 1/m.
    """
    check_shape("depth", depth, "h", "w")
    check_shape("static", static, *depth.shape)
    check_shape("rays", rays, *depth.shape, 3)
    check_shape("T_wc", T_wc, 4, 4)
    valid = (depth > 0) & depth.isfinite()
    nearest = -max_pool2d(-torch.where(valid, depth, torch.inf)[None], 3, 1, 1)[0]
    nearest, z, hits = nearest[valid].to(torch.float64), depth[valid].to(torch.float64), static[valid]
    a, b, c = rays[valid].to(torch.float64).unbind(dim=1)
    direction = torch.stack([(r[0] * a + r[1] * b + r[2] * c) / voxel_size for r in T_wc[:3, :3].tolist()], dim=1)
    origin = T_wc[:3, 3] / voxel_size
    free_depth = (nearest - (voxel_size / 2 + tolerance * (nearest * nearest))).clamp(max=max_depth)
    free = [torch.zeros(0, 3, dtype=torch.int64)]
    hits = (origin + direction * z[:, None])[hits & (z <= max_depth)].floor().to(torch.int64)
    voxel = origin.floor().to(torch.int64).expand_as(direction)
    forward = direction > 0
    exits = torch.where(direction == 0, torch.inf, (voxel + forward.to(torch.float64) - origin) / direction)
    depth_step, step = 1 / direction.abs(), torch.where(forward, 1, -1)
    while len(voxel):  # one voxel further along all rays (Amanatides and Woo, 1987)
        exit_depth, axis = exits.min(dim=1, keepdim=True)
        inside = exit_depth[:, 0] <= free_depth
        voxel, exits, axis = voxel[inside], exits[inside], axis[inside]
        depth_step, step, free_depth = depth_step[inside], step[inside], free_depth[inside]
        free.append(voxel)
        voxel = voxel.scatter_add(1, axis, step.gather(1, axis))
        exits = exits.scatter_add(1, axis, depth_step.gather(1, axis))
    return _group_by_block(torch.cat(free), hits)


def _group_by_block(free: Tensor, hits: Tensor) -> Observations:
    """Mark voxels (N, 3) and (M, 3) as free and hit, by block; a voxel can be in both."""
    voxels = torch.cat([free, hits])
    keys, row = cell_keys(voxels >> BITS).unique(return_inverse=True)
    index = row * VOLUME + index_in_block(voxels)
    marks = torch.zeros(len(keys) * VOLUME, dtype=torch.uint8)
    marks[index[: len(free)]] = FREE
    marks[index[len(free) :]] = HIT
    return Observations(cells_of_keys(keys), marks.reshape(-1, VOLUME))


def index_in_block(voxels: Tensor) -> Tensor:
    """Index of voxels in their blocks, with z varying fastest.

    Args:
        voxels: Coordinates of voxels, int64, shape :math:`(N, 3)`.

    Returns:
        Indices, int64, shape :math:`(N,)`.
    """
    x, y, z = (voxels & (SIDE - 1)).unbind(dim=1)
    return (x << 2 * BITS) | (y << BITS) | z
