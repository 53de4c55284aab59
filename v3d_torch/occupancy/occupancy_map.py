"""Occupancy map: a voxel grid of free, occupied and unknown space, with queries for planning."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from v3d_torch.config import OccupancyConfig
from v3d_torch.config.validation import to_float
from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_masks, check_shape
from v3d_torch.geometry.cell_keys import MAX_COORDINATE
from v3d_torch.geometry.se3 import are_rigid
from v3d_torch.kernels.voxel_blocks import SIDE, UNKNOWN
from v3d_torch.occupancy.clearance import NearestVoxels, are_balls_free, cube_gap
from v3d_torch.occupancy.ray_casting import observe_voxels
from v3d_torch.occupancy.sensor_model import SensorModel
from v3d_torch.occupancy.voxel_blocks import VoxelBlocks

_LOG = logging.getLogger(__name__)

_MAX_CAMERA_BLOCKS = MAX_COORDINATE // 2
"""Largest coordinate of a camera, blocks: the coordinates of all observed blocks then have keys."""

_ROTATION_TOLERANCE = 0.01
"""Maximum difference between an element of R R^T and of the identity, as for trajectory files."""

_KEPT_FRACTION = 0.9
"""Fraction of the maximum number of blocks that is kept when blocks are removed, so that removal is rare."""


class VoxelState(IntEnum):
    """State of a voxel."""

    UNKNOWN = -1
    """Never observed."""
    FREE = 0
    """Seen through, so that no static surface is in it."""
    OCCUPIED = 1
    """Contains a static surface."""


class _NearestInBox(NamedTuple):
    """Search of the nearest occupied voxels for points around which the box contains all voxels within the distance.

    Attributes:
        blocks: All blocks of the map.
        low: Smallest coordinates of the box, metres, float64, shape (3,).
        high: Largest coordinates of the box, metres, float64, shape (3,).
        search: Search of the voxels in the box.
    """

    blocks: VoxelBlocks
    low: Tensor
    high: Tensor
    search: NearestVoxels


class OccupancyMap:
    """Voxel grid with log-odds of occupancy, in the world frame.

    Voxel (i, j, k) is the cube between the corners (i, j, k) and (i + 1, j + 1, k + 1) in units of the voxel size. It
    is occupied if its probability is at least 0.5, and unknown if it was never observed. All queries take batches of
    points.

    `states`, `probability`, `is_free`, `distance` and `gradient` can be called from another thread while `integrate`
    runs. They see the map with or without the newest view, or with it in some voxels only.

    Args:
        config: Sensor model, size of voxels, bounds of memory and distances.
    """

    def __init__(self, config: OccupancyConfig) -> None:
        self.config = config
        self.blocks = VoxelBlocks()
        self.sensor_model = SensorModel.from_config(config)
        self._nearest: _NearestInBox | None = None
        self._is_full_window_reported = False

    @property
    def is_empty(self) -> bool:
        """True if nothing was observed yet."""
        return len(self.blocks) == 0

    @property
    def occupied_points(self) -> Tensor:
        """Centres of the occupied voxels, metres, float64, shape :math:`(N, 3)`."""
        return torch.cat(list(self.points_by_chunk(VoxelState.OCCUPIED)))

    @property
    def free_points(self) -> Tensor:
        """Centres of the free voxels, metres, float64, shape :math:`(N, 3)`."""
        return torch.cat(list(self.points_by_chunk(VoxelState.FREE)))

    def points_by_chunk(self, state: VoxelState) -> Iterator[Tensor]:
        """Yield the centres of the occupied or free voxels, one chunk of the map at a time, to save memory.

        Args:
            state: State of the voxels, not unknown.

        Returns:
            Centres, metres, float64, shape :math:`(N, 3)`, of each chunk; at least one tensor.
        """
        return _points_by_chunk(self.blocks, state, self.config.voxel_size)

    def integrate(self, depth: Tensor, static: Tensor, rays: Tensor, T_wc: Tensor) -> None:
        """Add the observations of a depth image.

        Args:
            depth: Depth, metres, float32, shape :math:`(h, w)`; 0, NaN or infinite = no measurement. Pixels can be
                subsampled.
            static: Mask of static pixels, bool, shape :math:`(h, w)`. Other pixels are not obstacles; they only show
                that the space in front of them is free.
            rays: Viewing ray of each pixel at unit depth, float32, shape :math:`(h, w, 3)`; see `PinholeCamera.rays`.
            T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.

        Raises:
            InputError: If ``static`` is not bool, the image has no pixels, or the pose is not a rigid transform or too
                far from the origin.
        """
        check_masks(static=static)
        if depth.numel() == 0:
            raise InputError(f"the depth image has shape {tuple(depth.shape)}; give an image with pixels")
        check_shape("T_wc", T_wc, 4, 4)
        config = self.config
        limit = _MAX_CAMERA_BLOCKS * SIDE * config.voxel_size
        if not bool(are_rigid(T_wc, _ROTATION_TOLERANCE)) or float(T_wc[:3, 3].abs().max()) > limit:
            raise InputError(
                f"the pose T_wc of a depth image is {T_wc.tolist()}; give a rigid transform, at most {limit:.0f} m from"
                " the origin"
            )
        limits = config.voxel_size, config.max_depth, config.inverse_depth_tolerance
        blocks = copy.copy(self.blocks)  # shares the voxels, while other threads read the blocks as they were
        blocks.add(observe_voxels(depth, static, rays, T_wc, *limits), self.sensor_model)
        if len(blocks) > config.max_blocks:
            self._remove_farthest(blocks, T_wc[:3, 3])
        self.blocks = blocks

    def states(self, points: Tensor) -> Tensor:
        """State of the voxel around each point.

        Args:
            points: Points, world frame, metres, shape :math:`(..., 3)`.

        Returns:
            Values of `VoxelState`, int8, shape :math:`(...)`.
        """
        log_odds = self.blocks.log_odds_at(self._voxels(points))
        states = torch.where(log_odds >= 0, VoxelState.OCCUPIED, VoxelState.FREE)
        return torch.where(log_odds == UNKNOWN, VoxelState.UNKNOWN, states).to(torch.int8).reshape(points.shape[:-1])

    def probability(self, points: Tensor) -> Tensor:
        """Probability that the voxel around each point is occupied.

        Args:
            points: Points, world frame, metres, shape :math:`(..., 3)`.

        Returns:
            Probabilities, float64, shape :math:`(...)`; NaN where space is unknown.
        """
        log_odds = self.blocks.log_odds_at(self._voxels(points))
        probability = torch.sigmoid(log_odds.to(torch.float64) * self.sensor_model.step)
        return torch.where(log_odds == UNKNOWN, torch.nan, probability).reshape(points.shape[:-1])

    def is_free(self, points: Tensor, radius: float | Tensor = 0.0) -> Tensor:
        """Check whether balls lie in free space. Unknown space is not free.

        Args:
            points: Centres of the balls, world frame, metres, shape :math:`(..., 3)`.
            radius: Radius of the balls, metres; a tensor with one value is accepted.

        Returns:
            True if every voxel that a ball touches is free, bool, shape :math:`(...)`; false for centres that are not
            finite.

        Raises:
            InputError: If the radius is negative or not finite.
        """
        radius = to_float(radius)
        if not (math.isfinite(radius) and radius >= 0):
            raise InputError(f"the radius of balls is {radius} m; give a finite radius of at least 0")
        rows = _rows(points)
        if 2 * radius > self._smallest_extent():  # such a ball touches unknown space; its voxels could be too many
            return torch.zeros(points.shape[:-1], dtype=torch.bool)
        free = are_balls_free(self.blocks, rows, radius, self.config.voxel_size).reshape(points.shape[:-1])
        # Centres that are not finite, or too far away for integers, touch no voxel.
        return free & (self.states(points) == VoxelState.FREE)

    def distance(self, points: Tensor) -> Tensor:
        """Distance to the centre of the nearest occupied voxel.

        Args:
            points: Points, world frame, metres, shape :math:`(..., 3)`.

        Returns:
            Euclidean distances, metres, truncated to ``max_distance``, float64, shape :math:`(...)`; NaN where space is
            unknown, and for points that are not finite. Differentiable in ``points``.
        """
        offset, near = self._offsets(points)
        distance = torch.where(near, torch.where(near[..., None], offset, 1.0).norm(dim=-1), self.config.max_distance)
        return torch.where(self.states(points) == VoxelState.UNKNOWN, torch.nan, distance)

    def gradient(self, points: Tensor) -> Tensor:
        """Gradient of the distance: the unit vector away from the nearest occupied voxel.

        Args:
            points: Points, world frame, metres, shape :math:`(..., 3)`.

        Returns:
            Gradients, float64, shape :math:`(..., 3)`; 0 where the distance is truncated or 0, NaN where space is
            unknown.
        """
        offset, near = self._offsets(points)
        gradient = torch.where(near[..., None], torch.nn.functional.normalize(offset.detach(), dim=-1), 0.0)
        return torch.where(self.states(points)[..., None] == VoxelState.UNKNOWN, torch.nan, gradient)

    def replace_blocks(self, blocks: VoxelBlocks) -> None:
        """Replace the content of the map."""
        self.blocks = blocks

    def state_dict(self) -> dict[str, Any]:
        """Return the blocks of the map."""
        return self.blocks.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the blocks of `state_dict`."""
        self.blocks = VoxelBlocks()
        self.blocks.load_state_dict(state)

    def _offsets(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Vectors from the nearest occupied voxels to points, (..., 3), and mask of those not truncated, (...)."""
        rows = _rows(points)
        nearest, near = self._nearest_around(rows)(rows)
        return points.to(torch.float64) - nearest.reshape(points.shape), near.reshape(points.shape[:-1])

    def _nearest_around(self, points: Tensor) -> NearestVoxels:
        """Return a search of the nearest voxels of points, float64, (N, 3).

        After a change of the map it has only the blocks around the points, because a planner asks for some places of
        each new map; if points elsewhere follow, it has the whole map.
        """
        blocks, stored, finite = self.blocks, self._nearest, points[points.isfinite().all(dim=1)]
        if len(finite) == 0:
            finite = points.new_zeros(1, 3)
        reach, side = self.config.max_distance, SIDE * self.config.voxel_size
        low, high = finite.amin(dim=0) - reach, finite.amax(dim=0) + reach
        is_newest = stored is not None and stored.blocks is blocks  # every change of the map makes other blocks
        if stored is not None and is_newest and bool((stored.low <= low).all() and (stored.high >= high).all()):
            return stored.search
        searched = blocks
        if is_newest:
            low, high = torch.full_like(low, -torch.inf), torch.full_like(high, torch.inf)
        else:
            corners = blocks.coordinates.to(torch.float64) * side
            searched = copy.copy(blocks)
            searched.keep(((corners + side >= low) & (corners <= high)).all(dim=1))
        occupied = torch.cat(list(_points_by_chunk(searched, VoxelState.OCCUPIED, self.config.voxel_size)))
        search = NearestVoxels(occupied, reach)
        self._nearest = _NearestInBox(blocks, low, high, search)
        return search

    def _smallest_extent(self) -> float:
        """Smallest side of the box around the stored blocks, metres; 0 without blocks."""
        blocks = self.blocks.coordinates
        if len(blocks) == 0:
            return 0.0
        sides = blocks.amax(dim=0) - blocks.amin(dim=0) + 1
        return int(sides.min()) * SIDE * self.config.voxel_size

    def _voxels(self, points: Tensor) -> Tensor:
        """Coordinates of the voxels around points (..., 3), int64, (N, 3)."""
        return (_rows(points) / self.config.voxel_size).floor().to(torch.int64)

    def _remove_farthest(self, blocks: VoxelBlocks, camera: Tensor) -> None:
        """Remove the blocks farthest from the camera, but no block within the window around the camera."""
        side = SIDE * self.config.voxel_size
        gap = cube_gap(camera, blocks.coordinates, side)
        kept = max(int(_KEPT_FRACTION * self.config.max_blocks), 1)
        limit = max(float(gap.kthvalue(kept).values), self.config.window_radius)
        is_kept = gap <= limit
        before, after = len(blocks), int(is_kept.sum())
        if after < before:
            blocks.keep(is_kept)
        if after > self.config.max_blocks:
            self._report_full_window(after)
        else:
            _LOG.warning(
                "occupancy map: %d of %d blocks were removed, all farther than %.1f m from the camera"
                " (occupancy.max_blocks is %d)", before - after, before, limit, self.config.max_blocks
            )  # fmt: skip

    def _report_full_window(self, count: int) -> None:
        """Warn once that more blocks than the maximum are within the window."""
        if not self._is_full_window_reported:
            _LOG.warning(
                "occupancy map: all %d blocks within %.1f m of the camera are kept, although occupancy.max_blocks is"
                " %d; set larger voxels (occupancy.voxel_size is %g m), or a larger occupancy.max_blocks",
                count, self.config.window_radius, self.config.max_blocks, self.config.voxel_size,
            )  # fmt: skip
        self._is_full_window_reported = True


def _points_by_chunk(blocks: VoxelBlocks, state: VoxelState, voxel_size: float) -> Iterator[Tensor]:
    """Yield the centres of voxels, see `OccupancyMap.points_by_chunk`."""
    for chunk in blocks.chunks():
        known, is_occupied = chunk.log_odds != UNKNOWN, chunk.log_odds >= 0
        voxels = chunk.voxels_where(is_occupied if state == VoxelState.OCCUPIED else known & ~is_occupied)
        yield (voxels.to(torch.float64) + 0.5) * voxel_size


def _rows(points: Tensor) -> Tensor:
    """Points (..., 3) as float64, (N, 3), without their graph."""
    check_shape("points", points, "*", 3)
    return points.detach().to(torch.float64).reshape(-1, 3)
