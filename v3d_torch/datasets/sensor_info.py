"""Cameras in the ``info.txt`` that recordings of BundleFusion, 12-Scenes and 3RScan have beside their frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from v3d_torch.errors import InputError
from v3d_torch.io.text_file import numbered_lines

_NAMES = ("info.txt", "_info.txt")

_COLOUR, _DEPTH, _SHIFT = "m_calibrationColorIntrinsic", "m_calibrationDepthIntrinsic", "m_depthShift"
"""Keys of the two camera matrices and of the depth scale."""

_EXPECTED = f"it states the cameras as {_COLOUR} = ..., {_DEPTH} = ..."


@dataclass(frozen=True)
class SensorInfo:
    """Cameras of a recording.

    Attributes:
        path: File that states them.
        K_colour: Camera matrix of the colour images, shape (3, 3).
        K_depth: Camera matrix of the depth images, shape (3, 3).
        depth_scale: Depth units per metre; None if they are not stated.
    """

    path: Path
    K_colour: NDArray[np.float64]
    K_depth: NDArray[np.float64]
    depth_scale: float | None


def find_sensor_info(folder: Path) -> SensorInfo | None:
    """Read the file that states the cameras of the frames in a folder; None if there is none.

    It is in the folder itself, or in its parent: 12-Scenes has the frames in a subfolder ``data``.

    Raises:
        InputError: As `read_sensor_info`.
    """
    files = (above / name for above in (folder, folder.resolve().parent) for name in _NAMES)
    found = (read_sensor_info(file) for file in files if file.is_file())
    return next((info for info in found if info is not None), None)


def read_sensor_info(path: Path) -> SensorInfo | None:
    """Read the cameras of a recording.

    Args:
        path: Text file.

    Returns:
        Cameras; None if the file has another content.

    Raises:
        InputError: If the file cannot be read, or one of its camera matrices is missing or has focal lengths below 1
            pixel.
    """
    values = _read_values(path)
    if _DEPTH not in values:
        return None
    shift = values.get(_SHIFT)
    try:
        depth_scale = None if shift is None else float(shift)
    except ValueError as error:
        raise InputError(f"{path}: {_SHIFT} is {shift}, not a number; copy the file again") from error
    return SensorInfo(path, _to_matrix(path, _COLOUR, values), _to_matrix(path, _DEPTH, values), depth_scale)


def _read_values(path: Path) -> dict[str, str]:
    """Read the values of lines ``key = value``."""
    lines = (line.partition("=") for _, line in numbered_lines(path, _EXPECTED))
    return {key.strip(): value.strip() for key, _, value in lines}


def _to_matrix(path: Path, key: str, values: dict[str, str]) -> NDArray[np.float64]:
    """Convert the sixteen numbers of a 4x4 matrix to a camera matrix, shape (3, 3)."""
    try:
        K = np.array(values.get(key, "").split(), dtype=np.float64).reshape(4, 4)[:3, :3]
    except ValueError as error:
        raise InputError(f"{path}: {key} is not a 4x4 matrix of 16 numbers; copy the file again") from error
    if not (np.isfinite(K).all() and K[0, 0] >= 1 and K[1, 1] >= 1):
        raise InputError(f"{path}: {key} has a focal length below 1 pixel; copy the file again")
    return K
