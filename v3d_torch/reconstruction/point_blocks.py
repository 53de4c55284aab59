"""Blocks of neighbouring points, of which a view checks only those that it can observe."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.frustum import are_in_frustum
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.geometry.voxel import pool_cloud
from v3d_torch.objects.depth_view import SpaceView

_BLOCK_SIZE = 0.5
"""Side of a block, metres: small against the frustum of a view, and large against the distance of the points."""

_MARGIN = 1e-3
"""Length by which the sphere around a block is enlarged, metres, so that rounding excludes no point."""


class PointBlocks:
    """Points grouped into cubes. A map can have millions of points and thousands of views, each of which observes few.

    Args:
        points: Positions, world frame, metres, float64, shape :math:`(P, 3)`.
    """

    def __init__(self, points: Tensor) -> None:
        pooled = pool_cloud(points, _BLOCK_SIZE)
        block, self._counts = pooled.voxel_index[0], pooled.counts[0]
        self._order = block.argsort(stable=True)
        self._ends = self._counts.cumsum(0)
        index, corners = block[:, None].expand(-1, 3), points.new_zeros(len(self._counts), 3)
        low = corners.scatter_reduce(0, index, points, "amin", include_self=False)
        high = corners.scatter_reduce(0, index, points, "amax", include_self=False)
        self._centres, self._radii = (low + high) / 2, (high - low).norm(dim=1) / 2 + _MARGIN

    def observable_by(self, view: SpaceView, camera: PinholeCamera, config: FreeSpaceConfig) -> Tensor:
        """Return the points of all blocks that can have a point for which `observe_free_space` is not NaN.

        Args:
            view: View.
            camera: Camera of the view.
            config: Tolerances of the free-space check.

        Returns:
            Indices of points, each at most once, int64, shape :math:`(K,)`.
        """
        centres = transform_points(view.T_dw, self._centres)
        near, far = centres[:, 2] - self._radii, centres[:, 2] + self._radii
        # The depth minus its tolerance is a concave function of the depth, so it is least at one end.
        least = torch.minimum(_nearest_measurable(near, config), _nearest_measurable(far, config))
        seen = (far > config.min_depth) & (least < float(view.nearest_depth.max()))
        seen &= are_in_frustum(centres, self._radii, camera)
        counts = self._counts[seen]
        begins = self._ends[seen] - counts  # in the order of blocks
        within = torch.arange(int(counts.sum())) - (counts.cumsum(0) - counts).repeat_interleave(counts)
        return self._order[begins.repeat_interleave(counts) + within]


def _nearest_measurable(depth: Tensor, config: FreeSpaceConfig) -> Tensor:
    """Depth that a view must at least measure to observe a point, metres."""
    return depth - (config.inverse_depth_tolerance * depth.square()).clamp(min=config.min_tolerance)
