"""Occupancy mapping: integration of frames, and correction of the map when poses are corrected."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from v3d_torch.config import OccupancyConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.occupancy.floor import Floor, find_floor
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid, occupancy_grid
from v3d_torch.occupancy.occupancy_map import OccupancyMap
from v3d_torch.occupancy.range_view import RangeView
from v3d_torch.occupancy.up_direction import UpDirection, estimate_up
from v3d_torch.occupancy.view_store import ViewStore, displacement
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.tracking.pose_history import PoseHistory

_LOG = logging.getLogger(__name__)

_CHECK_INTERVAL = 10
"""Number of views between two checks for corrected poses: about a second."""

_MAX_DISPLACEMENT = 0.5
"""Maximum displacement of a view that does not cause a rebuild of the map, voxels."""

_FIRST_SEARCH = 16
"""Number of views after which the floor is first searched: a second and a half. It is searched again whenever their
number has doubled, because a search takes up to a tenth of a second."""

_SEARCH_INTERVAL = 32
"""Number of views between two searches while no floor is known: three seconds. Until then ``map`` of ROS is tilted."""

_REBUILD_VIEWS = 4
"""Number of stored views that are added with each new view during a rebuild, which is spread over many frames."""


class OccupancyMapper(StatefulComponent):
    """Adds frames to an occupancy map.

    All added range views are stored. When bundle adjustment or a loop has moved one of them by more than half a voxel,
    a new map is built from all views, a few per frame, and then replaces the current map. It equals the map that the
    corrected poses would have given from the start.

    Args:
        config: Occupancy map.
        camera: Camera of all frames.

    Attributes:
        map: The occupancy map.
        up: Approximate up direction, which `find_floor` refines.
        floor: Floor of the map when it was last found; None before.
    """

    _STATE = ("map", "_store", "_count", "floor", "up", "_rebuilt", "_rebuilt_views")

    def __init__(self, config: OccupancyConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self.map = OccupancyMap(config)
        self.up = estimate_up()
        self.floor: Floor | None = None
        self._store = ViewStore(config.max_views)
        self._count = 0
        self._rebuilt: OccupancyMap | None = None
        self._rebuilt_views = 0

    def __call__(
        self,
        depth: Tensor,
        static: Tensor,
        poses: PoseHistory,
        up: UpDirection | None = None,
        T_dc: Tensor | None = None,
    ) -> None:
        """Add a frame, if it is due and its pose is known.

        Args:
            depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
            static: Mask of static pixels, bool, shape :math:`(H, W)`.
            poses: Poses of all frames up to this one.
            up: Up direction as it is known now; None if nothing new is known.
            T_dc: Motion of the camera from the time of the colour image to that of the depth image, float64, shape
                :math:`(4, 4)`; None if both are simultaneous.
        """
        self.up = up or self.up
        frame = len(poses) - 1
        if frame % self._config.interval != 0 or not poses.is_localised:
            return
        view = RangeView.sample(self._count, depth[0], static, self._config.stride)
        self._store.append(view, frame, poses.T_cw, torch.eye(4, dtype=torch.float64) if T_dc is None else T_dc)
        self._count += 1
        self._integrate(self.map, len(self._store) - 1)
        if (kept := self._store.reduce()) is not None:
            self._rebuilt_views = int(kept[: self._rebuilt_views].sum())
        if self._rebuilt is None and self._count % _CHECK_INTERVAL == 0:
            self._begin_rebuild(poses)
        self._continue_rebuild(_REBUILD_VIEWS + 1)
        if self._is_search_due():
            self.floor = self.find_floor() or self.floor

    def find_floor(self) -> Floor | None:
        """Find the floor of the map as it is now; None if none is visible.

        It takes 0.1 s in a room, and 0.2 s in a map of 30 m.
        """
        return find_floor(self.map, self.up)

    def grid(self, heights: tuple[float, float] | None = None) -> OccupancyGrid | None:
        """Return the 2D grid above the floor; None if no floor is visible.

        Args:
            heights: Lowest and highest obstacle, metres above the floor; None for those of the configuration.
        """
        floor = self.find_floor()
        return None if floor is None else occupancy_grid(self.map, floor, heights)

    def correct(self, poses: PoseHistory) -> None:
        """Apply all corrections of the poses at once, and search the floor; call this after the last frame.

        Args:
            poses: Poses of all frames.
        """
        self._continue_rebuild(len(self._store))  # it can contain views that are not stored any more
        self._begin_rebuild(poses)
        self._continue_rebuild(len(self._store))
        self.floor = self.find_floor() or self.floor

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`: the map, the stored views, and the state of a rebuild."""
        self._rebuilt = None if state["rebuilt"] is None else OccupancyMap(self._config)
        super().load_state_dict(state)

    def _is_search_due(self) -> bool:
        """Check whether the floor is searched after this view."""
        if self.floor is None and self._count % _SEARCH_INTERVAL == 0:
            return True
        return self._count >= _FIRST_SEARCH and self._count.bit_count() == 1

    def _begin_rebuild(self, poses: PoseHistory) -> None:
        """Begin a rebuild if a view has moved too far."""
        T_dw = self._store.T_dc @ poses.poses_of(self._store.frames)
        moved = displacement(T_dw, self._store.T_dw)
        if not (moved > _MAX_DISPLACEMENT * self._config.voxel_size).any():
            return
        _LOG.info("occupancy map: rebuilt from %d views, which moved by up to %.3f m", len(moved), float(moved.max()))
        self._store.T_dw = T_dw
        self._rebuilt, self._rebuilt_views = OccupancyMap(self._config), 0

    def _continue_rebuild(self, count: int) -> None:
        """Continue a rebuild with the next stored views; after the last one, replace the map."""
        if self._rebuilt is None:
            return
        end = min(self._rebuilt_views + count, len(self._store))
        for position in range(self._rebuilt_views, end):
            self._integrate(self._rebuilt, position)
        self._rebuilt_views = end
        if end == len(self._store):
            if self._store.has_removed_far:  # what only removed views have seen stays as it was
                self._rebuilt.blocks.copy_better_observed(self.map.blocks)
            self.map.replace_blocks(self._rebuilt.blocks)
            self._rebuilt, self._rebuilt_views = None, 0

    def _integrate(self, occupancy: OccupancyMap, position: int) -> None:
        """Add a stored view to a map."""
        view = self._store.views[position]
        rays = view.rays(self._camera, self._config.stride)
        occupancy.integrate(view.depth, view.static, rays, invert(self._store.T_dw[position]))
