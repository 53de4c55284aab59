"""The coloured map of what stands still: keyframes' static pixels, fused by voxels after all corrections."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from v3d_torch.config import Config
from v3d_torch.geometry.camera import back_project
from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.geometry.normals import surface_normals
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.mapping.static_views import StaticView, StaticViews
from v3d_torch.reconstruction.free_space import seen_as_free

_BATCH = 1_000_000
"""Points that wait to be taken into the map: hundreds of MB less than all at once, and as fast."""


@dataclass(frozen=True)
class PointMap:
    """Coloured points with normals.

    Attributes:
        points: world frame, metres, float32, shape :math:`(N, 3)`.
        colours: RGB, uint8, shape :math:`(N, 3)`.
        normals: unit vectors out of the surface, float32, shape :math:`(N, 3)`.
    """

    points: Tensor
    colours: Tensor
    normals: Tensor

    def __len__(self) -> int:
        return self.points.shape[0]


@torch.no_grad()
def fuse_points(views: StaticViews, config: Config) -> PointMap:
    """All views in the world, one point per voxel: the mean of place, colour and normal.

    What has no normal lies on the edge of a surface and stays out: depth there is a mean of what is before and behind.
    So does what as many views look through as see it: people whom a mask missed are there in a few views only.

    Args:
        views: of keyframes.
        config: of the dense map, and of what counts as looked through.
    """
    size = config.dense_map.voxel_size
    sums, counts = torch.zeros(0, 9, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    waiting: list[Tensor] = []
    for view in views:
        waiting.append(_rows(view, views, config))
        if sum(map(len, waiting)) > max(_BATCH, len(sums)):  # a map that grows is gone through ever more seldom
            sums, counts, waiting = *_take_in(sums, counts, waiting, size), []
    sums, counts = _take_in(sums, counts, waiting, size)
    means = sums / counts[:, None]
    means = means[~seen_as_free(means[:, :3], views, config.objects.free_space)]
    return PointMap(
        points=means[:, :3].to(torch.float32),
        colours=means[:, 3:6].round().to(torch.uint8),
        normals=normalize(means[:, 6:], dim=1).to(torch.float32),
    )


def _rows(view: StaticView, views: StaticViews, config: Config) -> Tensor:
    """What a view adds to the map: place, colour and normal of its points, float64, shape (N, 9)."""
    depth = view.depth[None, None]
    smooth = smooth_depth(depth, config.depth.kernel_size, config.depth.sigma, config.depth.edge_ratio)
    normals = surface_normals(back_project(smooth, views.rays))[0]
    keep = (normals != 0).any(dim=-1) & (depth[0, 0] <= config.dense_map.max_depth)
    points = back_project(depth, views.rays)[0][keep].to(torch.float64)
    R_wc, t_wc = view.T_wc[:3, :3], view.T_wc[:3, 3]
    colours = view.colour.permute(1, 2, 0)[keep].to(torch.float64)
    return torch.cat([points @ R_wc.T + t_wc, colours, normals[keep].to(torch.float64) @ R_wc.T], dim=1)


def _take_in(sums: Tensor, counts: Tensor, waiting: list[Tensor], size: float) -> tuple[Tensor, Tensor]:
    """Sums and numbers of points per voxel, with those that wait."""
    sums = torch.cat([sums, *waiting])
    counts = torch.cat([counts, torch.ones(len(sums) - len(counts), dtype=counts.dtype)])
    places = (sums[:, :3] / counts[:, None])[None]
    voxels = voxel_pool(places, torch.ones(places.shape[:2], dtype=torch.bool), size)
    occupied = voxels.counts.shape[1]
    return (
        sums.new_zeros(occupied, 9).index_add_(0, voxels.voxel_index[0], sums),
        counts.new_zeros(occupied).index_add_(0, voxels.voxel_index[0], counts),
    )
