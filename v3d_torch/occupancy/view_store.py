"""Stored range views: a bounded number of views, from which the occupancy map can be rebuilt."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert
from v3d_torch.occupancy.range_view import RangeView
from v3d_torch.runtime.stateful import StatefulComponent

_LOG = logging.getLogger(__name__)

LEVER = 2.0
"""Distance at which rotations are measured as displacements, metres: the typical depth in a room."""

_MIN_CELL, _MAX_CELL = 0.05, 0.4
"""Minimum and maximum side of a cell of poses, metres: even in the largest cell, most of the images of two views
overlap."""

_KEPT_FRACTION = 0.9
"""Fraction of the capacity that is kept when views are removed, so that removal is rare."""


class ViewStore(StatefulComponent):
    """Range views in the order of time.

    If there are too many views, the space of poses is divided into cells, and only the newest view of each cell is
    kept, which also shows which objects were removed. The cells grow until the views are few enough. If the largest
    cells do not suffice, the views farthest from the camera are removed.

    Args:
        capacity: Maximum number of views.

    Attributes:
        views: Views.
        frames: Position of each view's frame in the pose history.
        T_dc: Motion of the camera from the time of the colour image to that of the depth image of each view, float64,
            shape :math:`(N, 4, 4)`.
        T_dw: World-to-camera pose at the time of the depth image, with which each view was added to the occupancy map,
            float64, shape :math:`(N, 4, 4)`.
        has_removed_far: True if views were removed because they were far from the camera, so that the other views do
            not show all places.
    """

    _STATE = ("views", "frames", "T_dc", "T_dw", "has_removed_far")

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self.views: list[RangeView] = []
        self.frames: list[int] = []
        self.T_dc = torch.zeros(0, 4, 4, dtype=torch.float64)
        self.T_dw = torch.zeros(0, 4, 4, dtype=torch.float64)
        self.has_removed_far = False

    def __len__(self) -> int:
        return len(self.views)

    def append(self, view: RangeView, frame: int, T_cw: Tensor, T_dc: Tensor) -> None:
        """Append a view.

        Args:
            view: View.
            frame: Position of its frame in the pose history.
            T_cw: World-to-camera pose of the frame, float64, shape :math:`(4, 4)`.
            T_dc: Motion of the camera from the time of the colour image to that of the depth image, float64, shape
                :math:`(4, 4)`.
        """
        self.T_dc = torch.cat([self.T_dc, T_dc[None]])
        self.T_dw = torch.cat([self.T_dw, (T_dc @ T_cw)[None]])
        # New lists, because the old ones can be part of a stored state.
        self.views, self.frames = [*self.views, view], [*self.frames, frame]

    def reduce(self) -> Tensor | None:
        """Remove views if there are too many.

        Returns:
            Mask of the views that were kept, bool, shape :math:`(N,)`; None if there are not too many.
        """
        if len(self) <= self._capacity:
            return None
        limit, cell = max(int(_KEPT_FRACTION * self._capacity), 1), _MIN_CELL
        kept = self._newest_per_cell(cell)
        while int(kept.sum()) > limit and cell < _MAX_CELL:
            cell = 2 * cell
            kept = self._newest_per_cell(cell)
        if int(kept.sum()) > limit:
            centres = invert(self.T_dw)[:, :3, 3]
            order = torch.nonzero(kept)[:, 0]
            order = order[(centres[order] - centres[-1]).norm(dim=1).argsort(stable=True)]
            kept[order[limit:]] = False
            self.has_removed_far = True
            _LOG.warning("occupancy map: the %d views farthest from the camera were removed", len(order) - limit)
        self.T_dc, self.T_dw = self.T_dc[kept], self.T_dw[kept]
        self.views = [view for view, keep in zip(self.views, kept.tolist(), strict=True) if keep]
        self.frames = [frame for frame, keep in zip(self.frames, kept.tolist(), strict=True) if keep]
        return kept

    def _newest_per_cell(self, side: float) -> Tensor:
        """Mask of the newest view in each cell of poses, bool, (N,)."""
        T_wd = invert(self.T_dw)
        pose = torch.cat([T_wd[:, :3, 3], LEVER * T_wd[:, :3, 1], LEVER * T_wd[:, :3, 2]], dim=1)
        _, cell = (pose / side).floor().unique(dim=0, return_inverse=True)
        newest = torch.zeros(len(self), dtype=torch.int64).scatter_reduce(0, cell, torch.arange(len(self)), "amax")
        return newest[cell] == torch.arange(len(self))


def displacement(T_cw: Tensor, other: Tensor) -> Tensor:
    """Displacement between camera poses: distance of the centres plus the rotation angle times `LEVER`.

    Args:
        T_cw: World-to-camera poses, float64, shape :math:`(N, 4, 4)`.
        other: World-to-camera poses, float64, shape :math:`(4, 4)` or :math:`(N, 4, 4)`.

    Returns:
        Displacements, metres, float64, shape :math:`(N,)`.
    """
    T = T_cw @ invert(other)
    # |R - I| is 2 sqrt(2) sin(angle / 2), which is exact for small angles, unlike the arc cosine of the trace.
    chord = (T[:, :3, :3] - torch.eye(3, dtype=T.dtype)).flatten(1).norm(dim=1) / 8**0.5
    return T[:, :3, 3].norm(dim=1) + LEVER * 2 * chord.clamp(max=1).asin()
