"""Keys of the cells of an infinite grid: one 64-bit integer per cell, in the order of x, then y, then z."""

from __future__ import annotations

import torch
from torch import Tensor

MAX_COORDINATE = 2**20
"""Bound of coordinates, so that three of them fit into 63 bits: cells of 0.1 m reach 100 km from the origin."""


def cell_keys(cells: Tensor) -> Tensor:
    """Pack the coordinates of cells into keys.

    Args:
        cells: Coordinates in [-`MAX_COORDINATE`, `MAX_COORDINATE`), int64, shape :math:`(N, 3)`.

    Returns:
        Keys, int64, shape :math:`(N,)`; different cells have different keys.
    """
    x, y, z = (cells + MAX_COORDINATE).unbind(dim=1)
    return (x * 2 * MAX_COORDINATE + y) * 2 * MAX_COORDINATE + z


def cells_of_keys(keys: Tensor) -> Tensor:
    """Unpack keys into coordinates of cells; the inverse of `cell_keys`.

    Args:
        keys: Keys, int64, shape :math:`(N,)`.

    Returns:
        Coordinates, int64, shape :math:`(N, 3)`.
    """
    x = keys.div(4 * MAX_COORDINATE**2, rounding_mode="floor")
    y = keys.div(2 * MAX_COORDINATE, rounding_mode="floor")
    return torch.stack([x, y, keys], dim=1) % (2 * MAX_COORDINATE) - MAX_COORDINATE
