"""Coloured point map of the static scene, fused by voxels from the static views of the keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from v3d_torch.config import Config, FreeSpaceConfig
from v3d_torch.geometry.camera import back_project
from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.geometry.normals import surface_normals
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.geometry.voxel import pool_cloud
from v3d_torch.mapping.static_views import StaticView, StaticViews
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.free_space_check import observe_free_space
from v3d_torch.reconstruction.point_blocks import PointBlocks

_MIN_FREE_VIEWS = 3
"""Number of newest views that observe free space from which a surface that was observed before has gone. Single views
err at depth edges."""

_BATCH = 200_000
"""Number of points that are fused at once. Batches bound the memory, and take no longer than a single fusion."""


@dataclass(frozen=True)
class PointMap:
    """Coloured points with normals.

    Attributes:
        points: Positions, world frame, metres, float32, shape :math:`(N, 3)`.
        colours: RGB, uint8, shape :math:`(N, 3)`.
        normals: Unit normals that point out of the surface, world frame, float32, shape :math:`(N, 3)`.
    """

    points: Tensor
    colours: Tensor
    normals: Tensor

    def __len__(self) -> int:
        return self.points.shape[0]


@torch.no_grad()
def fuse_points(views: StaticViews, config: Config) -> PointMap:
    """Fuse all views into one point per voxel: the mean position, colour and normal.

    Pixels without a normal are excluded. They lie at the edge of a surface, where depth is a mean of foreground and
    background. A fused point is removed if the views that observe free space at its position are at least as many as
    the views that observe a surface there. This removes people that a mask missed, because they are at one position in
    few views only. It is also removed if the newest views observe free space: a thing that stood there was taken away.

    Args:
        views: Static views of the keyframes.
        config: Configuration of the whole system: dense map, depth smoothing and free-space check.
    """
    size = config.dense_map.voxel_size
    sums, counts = torch.zeros(0, 9, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    batch: list[Tensor] = []
    for view in views:
        batch.append(_point_rows(view, views, config))
        # The threshold grows with the map, so that a large map is not processed again for each view.
        if sum(map(len, batch)) > max(_BATCH, len(sums)):
            sums, counts, batch = *_fuse_batch(sums, counts, batch, size), []
    sums, counts = _fuse_batch(sums, counts, batch, size)
    means = sums / counts[:, None]
    means = means[~_is_observed_free(means[:, :3], views, config.objects.free_space)]
    return PointMap(
        points=means[:, :3].to(torch.float32),
        colours=means[:, 3:6].round().to(torch.uint8),
        normals=normalize(means[:, 6:], dim=1).to(torch.float32),
    )


def _point_rows(view: StaticView, views: StaticViews, config: Config) -> Tensor:
    """Position, colour and normal of the points of a view, world frame, float64, shape (N, 9)."""
    depth = view.depth[None, None]
    smooth = smooth_depth(depth, config.depth.kernel_size, config.depth.sigma, config.depth.edge_ratio)
    normals = surface_normals(back_project(smooth, views.rays))[0]
    keep = (normals != 0).any(dim=-1) & (depth[0, 0] <= config.dense_map.max_depth)
    points = back_project(depth, views.rays)[0][keep].to(torch.float64)
    normals_w = normals[keep].to(torch.float64) @ view.T_wd[:3, :3].T
    colours = view.colour.permute(1, 2, 0)[keep].to(torch.float64)
    return torch.cat([transform_points(view.T_wd, points), colours, normals_w], dim=1)


def _fuse_batch(sums: Tensor, counts: Tensor, batch: list[Tensor], size: float) -> tuple[Tensor, Tensor]:
    """Sums and numbers of points per voxel, after a batch of points is added."""
    sums = torch.cat([sums, *batch])
    counts = torch.cat([counts, torch.ones(len(sums) - len(counts), dtype=counts.dtype)])
    voxels = pool_cloud(sums[:, :3] / counts[:, None], size)
    occupied = voxels.counts.shape[1]
    return (
        sums.new_zeros(occupied, 9).index_add_(0, voxels.voxel_index[0], sums),
        counts.new_zeros(occupied).index_add_(0, voxels.voxel_index[0], counts),
    )


def _is_observed_free(points: Tensor, views: StaticViews, config: FreeSpaceConfig) -> Tensor:
    """Check which points are observed as free, by at least as many views as observe a surface, or by the newest ones.

    Points closer together than the depth tolerance share one check, and a view checks only the points that it can
    observe, which is faster.

    Args:
        points: Positions, world frame, metres, float64, shape :math:`(P, 3)`.
        views: Static views of the keyframes, ordered by time.
        config: Tolerances of the free-space check.

    Returns:
        Bool, shape :math:`(P,)`.
    """
    cells = pool_cloud(points, config.min_tolerance / 2)
    centres = cells.means[0].to(torch.float64)
    free, occupied, free_since = torch.zeros(3, len(centres), dtype=torch.int32)  # since the last observed surface
    blocks = PointBlocks(centres)
    for view in views:
        depth_view = DepthView(view.keyframe.stamp, view.depth[None], view.T_dw)
        rows = blocks.observable_by(depth_view, views.camera, config)
        state = observe_free_space(centres[rows], depth_view, views.camera, config)  # 1 free, 0 occupied, nan unknown
        free[rows] += state == 1
        occupied[rows] += state == 0
        free_since[rows] = (free_since[rows] + (state == 1)) * (state != 0)
    return ((free > 0) & ((free >= occupied) | (free_since >= _MIN_FREE_VIEWS)))[cells.voxel_index[0]]
