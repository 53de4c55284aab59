"""Views of the last seconds in the world frame, with which new views are compared."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.depth_view import StoredView
from v3d_torch.runtime.stateful import StatefulComponent


class StoredViews(StatefulComponent):
    """Base class of a comparison with earlier views; it stores them, oldest first."""

    _STATE = ("_views",)

    def __init__(self) -> None:
        self._views: list[StoredView] = []

    def _store(self, view: StoredView, max_age: float) -> None:
        """Store a view, newer than all stored ones, and drop those that are older than it by more than the age."""
        self._views = [stored for stored in self._views if stored.stamp >= view.stamp - max_age] + [view]

    def drop_views(self) -> None:
        """Remove the stored views, because the pose relative to them is not known."""
        self._views = []

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the stored views into the corrected world.

        Args:
            T_new_old: Transform from the old to the corrected world, float64, shape :math:`(4, 4)`.
        """
        self._views = [replace(view, T_dw=view.T_dw @ invert(T_new_old)) for view in self._views]
