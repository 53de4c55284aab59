"""Trajectory files in TUM format: lines of ``timestamp tx ty tz qx qy qz qw`` with camera-to-world poses."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from v3d_torch.datasets.groundtruth import GroundTruth
from v3d_torch.datasets.trajectory_columns import TUM_COLUMNS, read_header
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import are_rigid
from v3d_torch.io.files import write_text
from v3d_torch.io.numbers import parse_number
from v3d_torch.io.paths import StrPath
from v3d_torch.io.text_file import lines_and_comments, replace_odd_spaces
from v3d_torch.io.timestamps import MIN_NANOSECONDS, format_timestamp, parse_timestamp, round_timestamp
from v3d_torch.types import Trajectory

MAX_DISTANCE = 1e7
"""Maximum coordinate of a position, metres: the order of the earth's radius, for poses in a geocentric frame."""

ROTATION_TOLERANCE = 0.01
"""Maximum deviation of an element of R R^T from the identity: files with few digits round their rotations."""

_MAX_QUATERNION_NORM = 1e3
"""Maximum norm of a quaternion; its inverse is the minimum. Rounding and other scales stay within this range."""

_COLUMNS = " ".join(TUM_COLUMNS)


def read_trajectory(path: StrPath) -> Trajectory:
    """Read a trajectory in TUM format.

    Comments (#), blank lines, a byte order mark, all line endings and commas between the columns are accepted. A
    comment that names the columns states their order, such as that of EuRoC and evo, whose quaternions begin with the
    scalar. Quaternions are normalised and poses are sorted by timestamp. If a timestamp, rounded to 6 decimals, occurs
    more than once, the first line is used.

    Args:
        path: Path of a file with lines of ``timestamp tx ty tz qx qy qz qw``, or as a comment names them: seconds,
            metres, and a quaternion with the scalar last.

    Returns:
        Camera-to-world poses with timestamps in seconds. Convention: ``T_wc`` maps camera to world.

    Raises:
        InputError: If the file cannot be read, contains no poses, or contains an invalid line.
    """
    line_numbers, poses = _parse(Path(path))
    return _to_trajectory(path, line_numbers, poses)


def read_groundtruth(path: StrPath) -> GroundTruth:
    """Read the ground truth of a sequence, in TUM format; poses that are not finite are left out.

    Some tracking systems write such poses while they do not see the camera.

    Args:
        path: As for `read_trajectory`.

    Returns:
        Ground truth with at least one pose.

    Raises:
        InputError: As `read_trajectory`, but only if a timestamp or all poses are not finite.
    """
    line_numbers, poses = _parse(Path(path))
    is_measured = np.isfinite(poses[:, 1:]).all(axis=1)
    if not is_measured.any():
        is_measured = np.ones(len(poses), np.bool_)  # the error has the first line
    return GroundTruth(
        _to_trajectory(path, line_numbers[is_measured], poses[is_measured]), missing=int((~is_measured).sum())
    )


def _to_trajectory(path: StrPath, line_numbers: NDArray[np.int64], poses: NDArray[np.float64]) -> Trajectory:
    """Check the lines of a file and convert them to poses, see `read_trajectory`."""
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
            f"{format_timestamp(stamp)} " + " ".join(f"{value:.9f}" for value in pose) + "\n"
            for stamp, pose in zip(stamps, poses.tolist(), strict=True)
        ]
    write_text(Path(path), "".join(lines))


def _parse(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Parse a file to line numbers, counted from 1, shape (N,), and the columns of `TUM_COLUMNS`, shape (N, 8)."""
    line_numbers, poses = [], []
    header = None
    for number, line in lines_and_comments(path, f"a trajectory has lines of {_COLUMNS}"):
        if line.startswith("#"):
            header = read_header(line) or header
            continue
        line_numbers.append(number)
        poses.append(_parse_line(line, header, f"{path}: line {number}"))
    if not poses:
        raise InputError(f"{path}: contains no poses; copy it again, it must have lines of {_COLUMNS}")
    return np.array(line_numbers), np.array(poses, dtype=np.float64)


def _parse_line(line: str, header: list[str] | None, place: str) -> list[float]:
    """Parse a line to the columns of `TUM_COLUMNS`.

    Args:
        line: Line of the file.
        header: Names of its columns; None for those of the TUM format.
        place: File and number of the line, for messages.
    """
    words = replace_odd_spaces(line).replace(",", " ").split()
    columns = header or list(TUM_COLUMNS)
    if len(words) > len(columns):
        raise InputError(
            f"{place} has {len(words)} columns, expected {len(columns)}: {' '.join(columns)}; remove the others"
        )
    try:
        by_name = dict(zip(columns, words, strict=True))
        pose = [parse_timestamp(by_name["timestamp"]), *(parse_number(by_name[name]) for name in TUM_COLUMNS[1:])]
    except ValueError as error:
        raise InputError(f"{place} is {line[:80]!r}, expected {' '.join(columns)}; correct or remove it") from error
    if header is None and "," in line and float(by_name["timestamp"]) >= MIN_NANOSECONDS:
        raise InputError(
            f"{place} has commas and nanoseconds as in files of EuRoC, which have qw before qx, but no comment names"
            f" the columns; write them in their order above the first pose, such as # {_COLUMNS}"
        )
    return pose
