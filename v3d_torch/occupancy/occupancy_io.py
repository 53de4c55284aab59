"""Occupancy files: save an occupancy map with its floor, and load it for queries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from pydantic import ValidationError

from v3d_torch.config import OccupancyConfig
from v3d_torch.errors import InputError
from v3d_torch.geometry.cell_keys import MAX_COORDINATE
from v3d_torch.io.array_file import open_array_file, write_array_file
from v3d_torch.io.paths import StrPath
from v3d_torch.kernels.voxel_blocks import VOLUME
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_map import OccupancyMap

_FORMAT, _VERSION = "v3d_torch occupancy map", 1

_FIX = "give an occupancy.npz that a run wrote"


@dataclass(frozen=True)
class StoredOccupancy:
    """Occupancy map of an earlier run.

    Attributes:
        map: Map, in the world frame of the run.
        floor: Floor of the map; None if none was found.
    """

    map: OccupancyMap
    floor: Floor | None


def save_occupancy(path: StrPath, occupancy: OccupancyMap, floor: Floor | None = None) -> None:
    """Write an occupancy file. Equal maps give identical files.

    Args:
        path: Path of the file, with any suffix.
        occupancy: Map.
        floor: Floor of the map; None if none was found.

    Raises:
        OutputError: If the file cannot be written.
    """
    about = {
        "format": _FORMAT,
        "version": _VERSION,
        "config": occupancy.config.model_dump(mode="json"),
        "floor": None if floor is None else {"up": floor.up.tolist(), "offset": floor.offset, "area": floor.area},
    }
    blocks = occupancy.blocks
    arrays = {"coordinates": blocks.coordinates[blocks.rows].numpy(), "log_odds": blocks.log_odds[blocks.rows].numpy()}
    write_array_file(Path(path), about, arrays)


def load_occupancy(path: StrPath) -> StoredOccupancy:
    """Read an occupancy file.

    Args:
        path: Path of a file that `save_occupancy` or a run wrote.

    Raises:
        InputError: If the file is missing, not an occupancy file, damaged, or of another version.
    """
    path = Path(path)
    with open_array_file(path, _FORMAT, "an occupancy file", _FIX) as file:
        if file.about["version"] != _VERSION:
            raise InputError(
                f"{path}: has version {file.about['version']} of the format, but this program reads version {_VERSION};"
                " run the sequence again"
            )
        try:
            config = OccupancyConfig.model_validate(file.about["config"])
        except ValidationError as error:
            raise InputError(f"{path}: has the configuration of another version; run the sequence again") from error
        coordinates, log_odds = torch.from_numpy(file.read("coordinates")), torch.from_numpy(file.read("log_odds"))
        count = len(coordinates)
        if coordinates.dtype != torch.int64 or log_odds.dtype != torch.int8:
            raise ValueError("its arrays have other types")
        if coordinates.shape != (count, 3) or log_odds.shape != (count, VOLUME):
            raise ValueError("its arrays have other shapes")
        if not bool(((coordinates >= -MAX_COORDINATE) & (coordinates < MAX_COORDINATE)).all()):
            raise ValueError("the coordinates of its blocks are too large")
        floor = None
        if file.about["floor"] is not None:
            up = torch.tensor(file.about["floor"]["up"], dtype=torch.float64)
            numbers = float(file.about["floor"]["offset"]), float(file.about["floor"]["area"])
            if up.shape != (3,) or abs(float(up.norm()) - 1) > 1e-6 or not np.isfinite(numbers).all():
                raise ValueError("its floor is not a plane")
            floor = Floor(up, *numbers)
    occupancy = OccupancyMap(config)
    occupancy.load_state_dict({"coordinates": coordinates, "log_odds": log_odds})
    return StoredOccupancy(occupancy, floor)
