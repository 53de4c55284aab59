"""Free space: what earlier or later views look through was no part of the room."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.objects.free_space_check import DepthView, is_free_space


def seen_as_free(points: Tensor, views: StaticViews, config: FreeSpaceConfig) -> Tensor:
    """Whether as many views look through the places of points as see something there, and one at least.

    Points nearer to each other than depth can tell apart share the answer: a question for each would take several
    times as long.

    Args:
        points: world frame, metres, float64, shape :math:`(P, 3)`.
        views: of keyframes.
        config: what counts as looked through.

    Returns:
        Bool, shape :math:`(P,)`.
    """
    cells = voxel_pool(points[None], torch.ones(1, len(points), dtype=torch.bool), config.min_tolerance / 2)
    places = cells.means[0]
    through, filled = torch.zeros(2, len(places), dtype=torch.int32)
    for view in views:
        told = is_free_space(places, DepthView(view.keyframe.stamp, view.depth[None], view.T_cw), views.camera, config)
        through += told == 1
        filled += told == 0
    return ((through > 0) & (through >= filled))[cells.voxel_index[0]]
