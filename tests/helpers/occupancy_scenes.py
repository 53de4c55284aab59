"""Small scenes for occupancy maps: views of the box-shaped room, and maps with chosen voxels."""

from __future__ import annotations

import torch
from torch import Tensor

from helpers.box_room import CAMERA, CRATE, looking_around, render
from v3d_torch.config import OccupancyConfig
from v3d_torch.kernels.voxel_blocks import BITS, HIT, VOLUME
from v3d_torch.occupancy.occupancy_map import OccupancyMap
from v3d_torch.occupancy.range_view import RangeView
from v3d_torch.occupancy.ray_casting import Observations, index_in_block

CONFIG = OccupancyConfig(enabled=True, interval=1)
ALL = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)


def add_view(
    occupancy: OccupancyMap,
    number: int,
    T_wc: Tensor,
    *boxes: Tensor,
    static: Tensor = ALL,
    pose_in_map: Tensor | None = None,
) -> None:
    """Add a view of the room with boxes in it; the map can have another world frame than the room."""
    config = occupancy.config
    view = RangeView.sample(number, render(T_wc, *boxes)[0], static, config.stride)
    occupancy.integrate(
        view.depth, view.static, view.rays(CAMERA, config.stride), T_wc if pose_in_map is None else pose_in_map
    )


def map_of_room(views: int, config: OccupancyConfig = CONFIG) -> OccupancyMap:
    """Map of the room with the crate, from views in all directions."""
    occupancy = OccupancyMap(config)
    for number, T_wc in enumerate(looking_around(views)):
        add_view(occupancy, number, T_wc, CRATE)
    return occupancy


def map_of(occupied: Tensor, free: Tensor, config: OccupancyConfig = CONFIG) -> OccupancyMap:
    """Map in which voxels with these coordinates, (N, 3) each, are occupied and free, and all others unknown."""
    occupancy = OccupancyMap(config)
    voxels = torch.cat([occupied, free])
    marks = torch.cat([torch.full((len(occupied),), HIT), torch.ones(len(free), dtype=torch.int64)])
    blocks, row = (voxels >> BITS).unique(dim=0, return_inverse=True)
    grouped = torch.zeros(len(blocks), VOLUME, dtype=torch.uint8)
    grouped[row, index_in_block(voxels)] = marks.to(torch.uint8)
    occupancy.blocks.add(Observations(blocks, grouped), occupancy.sensor_model)
    return occupancy


def box_of_voxels(low: tuple[int, int, int], high: tuple[int, int, int]) -> Tensor:
    """Coordinates of all voxels from one corner to another, exclusive, int64, (N, 3)."""
    return torch.cartesian_prod(*(torch.arange(first, last) for first, last in zip(low, high, strict=True)))
