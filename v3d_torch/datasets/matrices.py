"""Matrices in text files: the poses and cameras of ScanNet and 7-Scenes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.errors import InputError
from v3d_torch.io.text import numbered_lines
from v3d_torch.types import Trajectory

_ROUNDED = 0.01
"""By so much a rotation may fail to be one, as files with few digits make it."""

_MAX_DISTANCE = 1e7
"""Metres from the origin, as in trajectories."""


def read_matrix(path: Path) -> NDArray[np.float64]:
    """Read a square matrix, a line per row.

    Returns:
        Shape (3, 3) or (4, 4); ``inf`` and ``nan`` may be in it.

    Raises:
        InputError: the file cannot be read or holds something else.
    """
    rows = [line.replace(",", " ").split() for _, line in numbered_lines(path, "a matrix has a line per row")]
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        matrix = np.empty(0)
    if matrix.shape not in ((3, 3), (4, 4)):
        raise InputError(f"{path}: is no matrix of 3 or 4 lines with as many numbers each; copy it again")
    return matrix


def read_poses(files: Mapping[float, Path]) -> Trajectory | None:
    """Poses of a camera, a file each, by their stamps in order of time.

    Returns:
        ``T_wc`` as it stands in the files, without those that are not finite, which mean that tracking was lost; None
        where no pose is left.

    Raises:
        InputError: a file is no 4x4 matrix, or not that of a motion.
    """
    known = {}
    for stamp, path in files.items():
        T_wc = read_matrix(path)
        if T_wc.shape != (4, 4):
            raise InputError(f"{path}: is no 4x4 matrix, as a pose is; copy it again")
        if not np.isfinite(T_wc).all():
            continue
        R = T_wc[:3, :3]
        if np.abs(T_wc).max() > _MAX_DISTANCE or np.abs(R @ R.T - np.eye(3)).max() > _ROUNDED or np.linalg.det(R) < 0:
            raise InputError(f"{path}: is not the motion of a camera, a rotation and a place; copy it again")
        known[stamp] = T_wc
    if not known:
        return None
    return Trajectory(torch.tensor(list(known), dtype=torch.float64), torch.from_numpy(np.stack(list(known.values()))))
