"""Matrices in files: plain text (ScanNet, 7-Scenes, Replica) and OpenCV's YAML (OpenLORIS-Scene)."""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.datasets.groundtruth import GroundTruth
from v3d_torch.datasets.tum_trajectory import MAX_DISTANCE, ROTATION_TOLERANCE
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import are_rigid
from v3d_torch.io.numbers import parse_number
from v3d_torch.io.safe_yaml import parse_yaml, to_valid_yaml
from v3d_torch.io.text_file import lines_and_comments, numbered_lines, read_text, replace_odd_spaces
from v3d_torch.types import Trajectory


def read_matrix(path: Path) -> NDArray[np.float64]:
    """Read a square matrix from a text file with one line per row.

    Args:
        path: Path of the text file.

    Returns:
        Matrix, float64, shape (3, 3) or (4, 4); it can contain ``inf`` and ``nan``.

    Raises:
        InputError: If the file cannot be read or does not contain such a matrix.
    """
    return _to_matrix(path, _read_lines(path))


def _read_lines(path: Path) -> list[str]:
    return [line for _, line in lines_and_comments(path, "a matrix has a line per row")]


def _to_matrix(path: Path, lines: list[str]) -> NDArray[np.float64]:
    """Convert the lines of a file to a square matrix, see `read_matrix`."""
    rows = [replace_odd_spaces(line).replace(",", " ").split() for line in lines if not line.startswith("#")]
    try:
        matrix = np.array([[parse_number(word) for word in row] for row in rows], dtype=np.float64)
    except ValueError:
        matrix = np.empty(0)
    if matrix.shape not in ((3, 3), (4, 4)):
        raise InputError(f"{path}: is not a 3x3 or 4x4 matrix; copy it again")
    return matrix


def read_poses(files: Mapping[float, Path]) -> GroundTruth | None:
    """Read camera poses from text files with one 4x4 matrix each.

    Args:
        files: Pose files by timestamp (seconds), in temporal order.

    Returns:
        Camera-to-world poses. Files that are empty, or have a pose that is not finite, mark lost tracking and are left
        out. None without files.

    Raises:
        InputError: If a file does not contain a 4x4 matrix, or the matrix is not a rigid transform.
    """
    poses = {}
    for stamp, path in files.items():
        if not (lines := _read_lines(path)):
            continue
        matrix = _to_matrix(path, lines)
        if matrix.shape != (4, 4):
            raise InputError(f"{path}: is not a 4x4 pose matrix; copy it again")
        if _is_measured(matrix, str(path)):
            poses[stamp] = matrix
    if not files:
        return None
    return _to_groundtruth(poses, len(files))


def read_pose_lines(path: Path, rate: float) -> GroundTruth:
    """Read camera poses from a text file with one 4x4 matrix per line, in row-major order.

    Args:
        path: File whose line i, from 0, is the pose of frame i.
        rate: Frame rate, Hz: converts frame numbers to timestamps.

    Returns:
        Camera-to-world poses. Poses that are not finite mark lost tracking and are left out.

    Raises:
        InputError: If the file cannot be read, or a line is not a rigid transform.
    """
    poses, lines = {}, list(numbered_lines(path, "each line is a 4x4 matrix of 16 numbers"))
    for frame, (number, line) in enumerate(lines):
        try:
            matrix = np.array([parse_number(word) for word in line.replace(",", " ").split()]).reshape(4, 4)
        except ValueError as error:
            raise InputError(f"{path}: line {number} is not a 4x4 matrix of 16 numbers; copy it again") from error
        if _is_measured(matrix, f"{path}: line {number}"):
            poses[frame / rate] = matrix
    return _to_groundtruth(poses, len(lines))


def _is_measured(matrix: NDArray[np.float64], source: str) -> bool:
    """Check whether a pose, shape (4, 4), is finite; raise InputError if it is finite but no rigid transform."""
    if not np.isfinite(matrix).all():
        return False
    if np.abs(matrix).max() > MAX_DISTANCE or not are_rigid(torch.from_numpy(matrix), ROTATION_TOLERANCE):
        raise InputError(f"{source}: is not a valid rigid transform; copy it again")
    return True


def _to_groundtruth(poses: Mapping[float, NDArray[np.float64]], count: int) -> GroundTruth:
    """Return the poses by their timestamps as ground truth, of which there were ``count`` with those left out."""
    stamps = torch.tensor(list(poses), dtype=torch.float64)
    T_wc = torch.from_numpy(np.array(list(poses.values()), dtype=np.float64).reshape(-1, 4, 4))
    return GroundTruth(Trajectory(stamps, T_wc), missing=count - len(poses))


def read_opencv_yaml(path: Path) -> Any:
    """Read a YAML file written by OpenCV, see `v3d_torch.io.safe_yaml`.

    Args:
        path: Path of the file.

    Returns:
        Content of the file. Matrices are mappings, see `opencv_matrix`.

    Raises:
        InputError: If the file cannot be read or is not valid.
    """
    text = read_text(path, "it contains YAML written by OpenCV")
    try:
        return parse_yaml(to_valid_yaml(text))
    except ValueError as error:
        raise InputError(f"{path}: is not valid OpenCV YAML ({error}); copy it again") from error


def opencv_matrix(node: Any, *shape: int) -> NDArray[np.float64]:
    """Convert a matrix node of `read_opencv_yaml` to an array of the given shape (row-major).

    Raises:
        ValueError: If the node is not a matrix with this number of elements.
    """
    data = node.get("data") if isinstance(node, dict) else None
    if not isinstance(data, list) or len(data) != prod(shape):
        raise ValueError(f"not a matrix of {prod(shape)} numbers")
    # YAML parses numbers such as 1e-05, which have no decimal point, as strings.
    return np.array([float(number) for number in data], dtype=np.float64).reshape(shape)
