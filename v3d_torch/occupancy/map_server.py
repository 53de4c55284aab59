"""2D grids as files of the map_server of ROS: an image ``.pgm`` and its description ``.yaml``."""

from __future__ import annotations

from pathlib import Path

import torch
import yaml

from v3d_torch.errors import OutputError
from v3d_torch.io.files import atomic_write, write_text
from v3d_torch.io.paths import StrPath
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid
from v3d_torch.occupancy.occupancy_map import VoxelState

_GREY = {VoxelState.OCCUPIED: 0, VoxelState.UNKNOWN: 205, VoxelState.FREE: 254}
"""Grey values of map_saver. map_server reads a pixel as occupied if (255 - grey) / 255 is above the occupied threshold,
as free if it is below the free threshold, and otherwise as unknown."""

_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196
"""Thresholds of map_saver."""

_DECIMALS = 6
"""Decimals of the origin, metres: micrometres are far below the size of a cell."""


def write_map_server_files(path: StrPath, grid: OccupancyGrid) -> None:
    """Write a grid as ``.pgm`` and ``.yaml``.

    Args:
        path: Path of the YAML file, ``.yaml`` or ``.yml``; the image is written beside it.
        grid: 2D grid, see `occupancy_grid`.

    Raises:
        OutputError: If the path has another suffix, or a file cannot be written.
    """
    path = Path(path)
    if path.suffix not in (".yaml", ".yml"):
        raise OutputError(f"{path}: is not the name of a YAML file; choose a name that ends in .yaml")
    image = path.with_suffix(".pgm")
    values = torch.tensor([_GREY[state] for state in VoxelState], dtype=torch.uint8)
    grey = values[grid.states.flip(0).to(torch.int64) + 1]  # the first row of the image has the largest y
    height, width = grey.shape
    with atomic_write(image) as temporary:
        temporary.write_bytes(f"P5\n{width} {height}\n255\n".encode() + grey.numpy().tobytes())
    about = {
        "image": image.name,
        "mode": "trinary",
        "resolution": grid.cell_size,
        "origin": [*(round(value, _DECIMALS) for value in grid.origin), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
    }
    write_text(path, yaml.safe_dump(about, sort_keys=False, default_flow_style=None))
