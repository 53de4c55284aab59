"""Trajectory files in the layout of the TUM RGB-D benchmark: ``stamp tx ty tz qx qy qz qw`` of ``T_wc``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from v3d_torch.errors import InputError
from v3d_torch.io.files import write_text
from v3d_torch.io.paths import StrPath
from v3d_torch.io.text import numbered_lines
from v3d_torch.io.timestamps import parse_timestamp
from v3d_torch.types import Trajectory

_MAX_DISTANCE = 1e7
"""Metres from the origin: the radius of the earth, for ground truth in a geocentric frame."""

_MAX_LENGTH = 1e3
"""Of a quaternion, and its inverse the least: what is off by more is no rounding and no other scale."""

_COLUMNS = "stamp tx ty tz qx qy qz qw"


def read_trajectory(path: StrPath) -> Trajectory:
    """Read camera poses.

    Comments (#), blank lines, a byte order mark, either line ending and commas for spaces are allowed. Quaternions are
    normalised, poses come out in order of time, and of equal stamps the first counts.

    Args:
        path: lines of ``stamp tx ty tz qx qy qz qw``: seconds, metres, unit quaternion with the scalar last.

    Returns:
        Convention: ``T_wc`` maps camera to world, as the benchmark's files do.

    Raises:
        InputError: the file cannot be read, holds no pose, or a line is not eight sensible numbers with a rotation.
    """
    numbers, poses = _parse(Path(path))
    with np.errstate(over="ignore"):
        length = np.linalg.norm(poses[:, 4:], axis=1)
    for wrong, what in (
        (~np.isfinite(poses).all(axis=1), "a number that is not finite"),
        ((np.abs(poses[:, 1:4]) > _MAX_DISTANCE).any(axis=1), f"a position more than {_MAX_DISTANCE:g} m away"),
        (~((length > 1 / _MAX_LENGTH) & (length < _MAX_LENGTH)), "a quaternion of zeros, or far from a unit one"),
    ):
        if wrong.any():
            raise InputError(f"{path}: line {numbers[wrong.argmax()]} has {what}; remove or repair it")
    stamps, order = np.unique(poses[:, 0], return_index=True)
    T_wc = torch.eye(4, dtype=torch.float64).repeat(len(stamps), 1, 1)
    T_wc[:, :3, :3] = torch.from_numpy(Rotation.from_quat(poses[order, 4:]).as_matrix())
    T_wc[:, :3, 3] = torch.from_numpy(poses[order, 1:4])
    return Trajectory(torch.from_numpy(stamps), T_wc)


def write_trajectory(path: StrPath, trajectory: Trajectory) -> None:
    """Write camera poses whole or not at all: stamps with 6 decimals, the rest with 9, quaternions with qw >= 0.

    Args:
        path: file to write; its folder is made when it is not there.
        trajectory: poses; none make an empty file.

    Raises:
        InputError: what is given is no trajectory, or a pose in it no rigid motion.
        OutputError: when the folder cannot be written or the disk is full.
    """
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"write_trajectory takes a path and a Trajectory, this is a {type(trajectory).__name__}")
    T_wc = trajectory.T_wc.detach().numpy()
    with np.errstate(invalid="ignore"):
        rigid = np.isfinite(T_wc).all(axis=(1, 2)) & (np.linalg.det(T_wc[:, :3, :3]) > 0)
    if not rigid.all():
        raise InputError(f"{path}: pose {rigid.argmin()} has no rotation or no finite position; repair or leave it out")
    lines = []
    if len(trajectory):
        quaternions = Rotation.from_matrix(T_wc[:, :3, :3]).as_quat(canonical=True)
        poses = np.concatenate([T_wc[:, :3, 3], quaternions], axis=1).round(9) + 0.0  # + 0.0: no "-0.000000000"
        lines = [
            f"{stamp:.6f} " + " ".join(f"{value:.9f}" for value in pose) + "\n"
            for stamp, pose in zip(trajectory.stamps.tolist(), poses.tolist(), strict=True)
        ]
    write_text(Path(path), "".join(lines))


def _parse(path: Path) -> tuple[list[int], NDArray[np.float64]]:
    """Line numbers from 1, and the eight numbers of each line, shape (N, 8)."""
    numbers, poses = [], []
    for number, line in numbered_lines(path, f"a trajectory has lines of {_COLUMNS}"):
        words = line.replace(",", " ").split()
        try:
            pose = [parse_timestamp(word) for word in words[:1]] + [float(word) for word in words[1:]]
        except ValueError:
            pose = []
        if len(pose) != len(_COLUMNS.split()):
            raise InputError(f"{path}: line {number} is {line[:80]!r} where {_COLUMNS} is expected; repair it")
        numbers.append(number)
        poses.append(pose)
    if not poses:
        raise InputError(f"{path}: holds no pose; lines of {_COLUMNS} are expected, copy it again")
    return numbers, np.array(poses, dtype=np.float64)
