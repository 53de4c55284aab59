"""Stored range views: a bounded number of views, from which the occupancy map can be rebuilt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert
from v3d_torch.occupancy.range_view import RangeView

LEVER = 2.0
"""Distance at which rotations are measured as displacements, metres: the typical depth in a room."""


class ViewStore:
    """Range views in the order of time.

    Of too many views, the one is removed whose pose is nearest to that of a newer view: what is seen from everywhere is
    kept, and where views are alike, the newest is kept, which shows what has been taken away since.

    Args:
        capacity: Maximum number of views.

    Attributes:
        views: Views.
        frames: Position of each view's frame in the pose history.
        T_cw: World-to-camera pose with which each view is in the occupancy map, float64, shape :math:`(N, 4, 4)`.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self.views: list[RangeView] = []
        self.frames: list[int] = []
        self.T_cw = torch.zeros(0, 4, 4, dtype=torch.float64)
        self._to_newer = torch.zeros(0, dtype=torch.float64)  # displacement to the nearest newer view

    def __len__(self) -> int:
        return len(self.views)

    def append(self, view: RangeView, frame: int, T_cw: Tensor) -> None:
        """Append a view.

        Args:
            view: View.
            frame: Position of its frame in the pose history.
            T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
        """
        self._to_newer = torch.minimum(self._to_newer, displacement(self.T_cw, T_cw))
        self._to_newer = torch.cat([self._to_newer, self._to_newer.new_full((1,), torch.inf)])
        self.T_cw = torch.cat([self.T_cw, T_cw[None]])
        self.views.append(view)
        self.frames.append(frame)

    def remove_redundant(self) -> int | None:
        """Remove a view if there are too many.

        Returns:
            Position of the removed view; None if there are not too many.
        """
        if len(self) <= self._capacity:
            return None
        removed = int(self._to_newer.argmin())
        # The views to which it was the nearest newer one have another one now.
        affected = displacement(self.T_cw[:removed], self.T_cw[removed]) <= self._to_newer[:removed]
        kept = torch.arange(len(self)) != removed
        self.T_cw, self._to_newer = self.T_cw[kept], self._to_newer[kept]
        del self.views[removed], self.frames[removed]
        for row in torch.nonzero(affected)[:, 0].tolist():
            self._to_newer[row] = displacement(self.T_cw[row + 1 :], self.T_cw[row]).min()
        return removed

    def state_dict(self) -> dict[str, Any]:
        """Return the views."""
        return {"views": self.views, "frames": self.frames, "T_cw": self.T_cw, "to_newer": self._to_newer}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the views of `state_dict`."""
        self.views, self.frames = list(state["views"]), list(state["frames"])
        self.T_cw, self._to_newer = state["T_cw"], state["to_newer"].clone()


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
