"""Observations of a part of the map, as the input of a bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import make_measurements
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.membership import contains
from v3d_torch.optim.reprojection import Measurements


@dataclass(frozen=True)
class MapObservations:
    """M observations of L landmarks by P keyframes of a map.

    Attributes:
        rows: Rows of the observations in the table of the map, int64, shape :math:`(M,)`.
        keyframes: Indices of the keyframes, ascending, int64, shape :math:`(P,)`.
        landmarks: Ids of the landmarks, ascending, int64, shape :math:`(L,)`.
        pose: Position of the keyframe of each observation in ``keyframes``, int64, shape :math:`(M,)`.
        point: Position of the landmark of each observation in ``landmarks``, int64, shape :math:`(M,)`.
        measured: Measured pixels and inverse depths.
    """

    rows: Tensor
    keyframes: Tensor
    landmarks: Tensor
    pose: Tensor
    point: Tensor
    measured: Measurements

    def __len__(self) -> int:
        return len(self.rows)

    def arguments(self, K: Tensor, fixed: Tensor) -> dict[str, Any]:
        """Arguments of `bundle_adjust` and `estimate_readout` other than poses and points.

        Args:
            K: Camera matrix, shape :math:`(3, 3)`.
            fixed: Mask of the keyframes whose poses stay unchanged, bool, shape :math:`(P,)`.
        """
        return {**vars(self.measured), "pose": self.pose, "point": self.point, "K": K, "fixed": fixed}


def select_observations(tables: MapTables, window: Tensor, config: Config, *, with_neighbours: bool) -> MapObservations:
    """Select the observations of all active landmarks that given keyframes observe, if they have two observations.

    Args:
        tables: Data of the map.
        window: Indices of the keyframes, int64, shape :math:`(W,)`.
        config: Configuration of the whole system: measurement noise.
        with_neighbours: True to include the observations of the same landmarks by other keyframes.
    """
    # NumPy is faster than torch here.
    table, count = tables.observations, len(tables.landmarks)
    keyframe, landmark, valid = (table[name].numpy() for name in ("keyframe", "landmark", "valid"))
    usable = valid & tables.landmarks["active"].numpy().take(landmark)
    by_window = usable & contains(window.numpy(), keyframe, len(tables.keyframes))
    is_observed = contains(landmark[by_window], landmark, count)
    usable = usable if with_neighbours else by_window
    observers = np.bincount(landmark[usable], minlength=count)
    rows = torch.from_numpy(np.flatnonzero(usable & is_observed & (observers > 1).take(landmark)))
    keyframes, pose = unique_ids(table["keyframe"][rows], len(tables.keyframes))
    landmarks, point = unique_ids(table["landmark"][rows], count)
    names = ("uv", "inverse_depth", "octave", "sigma_ratio")
    uv, inverse_depth, octave, sigma_ratio = (table[name].index_select(0, rows) for name in names)
    measured = make_measurements(uv, inverse_depth, octave, sigma_ratio, config.tracking, config.features)
    return MapObservations(rows, keyframes, landmarks, pose, point, measured)


def unique_ids(ids: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Unique values of non-negative integers, as `torch.unique` returns them, without sorting.

    Args:
        ids: Integers in [0, count), int64, shape :math:`(N,)`.
        count: Exclusive upper bound of the ids.

    Returns:
        The unique ids in ascending order, int64, shape :math:`(D,)`, and the position of each id among the unique
        ids, int64, shape :math:`(N,)`.
    """
    present = torch.zeros(count, dtype=torch.bool).index_fill_(0, ids, True)
    return torch.nonzero(present)[:, 0], (present.cumsum(0) - 1).index_select(0, ids)
