"""Trajectory files in TUM format: lines of ``timestamp tx ty tz qx qy qz qw`` with camera-to-world poses."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import are_rigid
from v3d_torch.io.files import write_text
from v3d_torch.io.paths import StrPath
from v3d_torch.io.text_file import numbered_lines, replace_odd_spaces
from v3d_torch.io.timestamps import parse_timestamp, round_timestamp
from v3d_torch.types import Trajectory

MAX_DISTANCE = 1e7
"""Maximum coordinate of a position, metres: the order of the earth's radius, for poses in a geocentric frame."""

ROTATION_TOLERANCE = 0.01
"""Maximum deviation of an element of R R^T from the identity: files with few digits round their rotations."""

_MAX_QUATERNION_NORM = 1e3
"""Maximum norm of a quaternion; its inverse is the minimum. Rounding and other scales stay within this range."""

_COLUMNS = "timestamp tx ty tz qx qy qz qw"


def read_trajectory(path: StrPath) -> Trajectory:
    """Read a trajectory in TUM format.

    Comments (#), blank lines, a byte order mark, all line endings and commas between the columns are accepted.
    Quaternions are normalised and poses are sorted by timestamp. If a timestamp, rounded to 6 decimals, occurs more
    than once, the first line is used.

    Args:
        path: Path of a file with lines of ``timestamp tx ty tz qx qy qz qw``: seconds, metres, and a quaternion with
            the scalar last.

    Returns:
        Camera-to-world poses with timestamps in seconds. Convention: ``T_wc`` maps camera to world.

    Raises:
        InputError: If the file cannot be read, contains no poses, or contains an invalid line.
    """
    line_numbers, poses = _parse(Path(path))
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(poses[:, 4:], axis=1)
    for invalid, cause in (
        (~np.isfinite(poses).all(axis=1), "a number that is not finite"),
        ((np.abs(poses[:, 1:4]) > MAX_DISTANCE).any(axis=1), f"a position more than {MAX_DISTANCE:g} m away"),
        (
            ~((norms > 1 / _MAX_QUATERNION_NORM) & (norms < _MAX_QUATERNION_NORM)),
            "a quaternion that is zero or far from unit length",
        ),
    ):
        if invalid.any():
            raise InputError(f"{path}: line {line_numbers[invalid.argmax()]} has {cause}; correct or remove it")
    _, order = np.unique([round_timestamp(stamp) for stamp in poses[:, 0].tolist()], return_index=True)
    T_wc = torch.eye(4, dtype=torch.float64).repeat(len(order), 1, 1)
    T_wc[:, :3, :3] = torch.from_numpy(Rotation.from_quat(poses[order, 4:]).as_matrix())
    T_wc[:, :3, 3] = torch.from_numpy(poses[order, 1:4])
    return Trajectory(torch.from_numpy(poses[order, 0]), T_wc)


def write_trajectory(path: StrPath, trajectory: Trajectory, *, comment: str | None = None) -> None:
    """Write a trajectory in TUM format.

    Timestamps have 6 decimals, the other columns 9. Quaternions have qw >= 0. The file is replaced atomically, so that
    it is never incomplete.

    Args:
        path: Path of the file; missing folders are created.
        trajectory: Camera-to-world poses; an empty trajectory creates a file without poses.
        comment: Comment for the first line, or lines; None for no comment.

    Raises:
        InputError: If ``trajectory`` is not a `Trajectory`, one of its poses is not a rigid transform, or two of
            its timestamps are equal when rounded.
        OutputError: If the file cannot be written or the disk is full.
    """
    if not isinstance(trajectory, Trajectory):
        raise InputError(
            f"write_trajectory: expected a Trajectory, got {type(trajectory).__name__}; pass the path first"
        )
    T_wc = trajectory.T_wc.detach().numpy()
    is_rigid = are_rigid(trajectory.T_wc.detach(), ROTATION_TOLERANCE).numpy()
    if not is_rigid.all():
        raise InputError(f"{path}: pose {is_rigid.argmin()} is not a valid rigid transform; repair or remove it")
    stamps = [round_timestamp(stamp) for stamp in trajectory.stamps.tolist()]
    for index, (before, after) in enumerate(pairwise(stamps)):
        if after == before:
            raise InputError(
                f"{path}: poses {index} and {index + 1} both have the time {after:.6f} s, rounded to 6 decimals; give"
                " times in seconds, at least a microsecond apart"
            )
    lines = [] if comment is None else ["# " + "\n# ".join(comment.splitlines()) + "\n"]
    if len(trajectory):
        quaternions = Rotation.from_matrix(T_wc[:, :3, :3]).as_quat(canonical=True)
        poses = np.concatenate([T_wc[:, :3, 3], quaternions], axis=1).round(9) + 0.0  # + 0.0: no "-0.000000000"
        lines += [
            f"{stamp:.6f} " + " ".join(f"{value:.9f}" for value in pose) + "\n"
            for stamp, pose in zip(stamps, poses.tolist(), strict=True)
        ]
    write_text(Path(path), "".join(lines))


def _parse(path: Path) -> tuple[list[int], NDArray[np.float64]]:
    """Parse a file to line numbers, counted from 1, and the eight columns of each line, shape (N, 8)."""
    line_numbers, poses = [], []
    for number, line in numbered_lines(path, f"a trajectory has lines of {_COLUMNS}"):
        words = replace_odd_spaces(line).replace(",", " ").split()
        try:
            pose = [parse_timestamp(word) for word in words[:1]] + [float(word) for word in words[1:]]
        except ValueError:
            pose = []
        if len(pose) != len(_COLUMNS.split()):
            raise InputError(f"{path}: line {number} is {line[:80]!r}, expected {_COLUMNS}; correct or remove it")
        line_numbers.append(number)
        poses.append(pose)
    if not poses:
        raise InputError(f"{path}: contains no poses; copy it again, it must have lines of {_COLUMNS}")
    return line_numbers, np.array(poses, dtype=np.float64)
