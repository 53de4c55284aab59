"""File with the direction of gravity at the first frame of a sequence in TUM layout."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

from v3d_torch.errors import InputError
from v3d_torch.io.files import write_text
from v3d_torch.io.text_file import numbered_lines, replace_odd_spaces
from v3d_torch.io.timestamps import format_timestamp, parse_timestamp

_LOG = logging.getLogger(__name__)

GRAVITY_FILE = "gravity.txt"
"""Name of the file in the folder of the sequence."""

_COLUMNS = "stamp gx gy gz"

_MAX_NORM_ERROR = 1e-3
"""Maximum difference between the length of the vector and 1."""

_MAX_STAMP_ERROR = 1e-6
"""Maximum difference between the stamps of file and frame, seconds: both are written with six decimals."""


def write_gravity_file(folder: Path, stamp: float, gravity: Tensor) -> None:
    """Write the direction of gravity at the first frame.

    Args:
        folder: Folder of the sequence.
        stamp: Time of the colour image of the frame, seconds.
        gravity: Unit vector that points down, camera frame, shape :math:`(3,)`.

    Raises:
        OutputError: If the file cannot be written.
    """
    vector = " ".join(f"{value:.9f}" for value in gravity.tolist())
    write_text(
        folder / GRAVITY_FILE, f"# {_COLUMNS}: unit vector in the camera frame\n{format_timestamp(stamp)} {vector}\n"
    )


def read_gravity_file(path: Path, first_stamp: float) -> Tensor | None:
    """Read the direction of gravity at the first frame.

    Args:
        path: File with one line ``stamp gx gy gz``.
        first_stamp: Time of the first colour image, seconds.

    Returns:
        Unit vector that points down, camera frame, float64, shape :math:`(3,)`. None if the file is of another frame,
        because the list of images was changed; this is logged.

    Raises:
        InputError: If the file cannot be read, or is not one line with the stamp and a unit vector.
    """
    expected = f"it has one line {_COLUMNS}, with a unit vector"
    lines = list(numbered_lines(path, expected))
    try:
        ((_, line),) = lines
        first, x, y, z = replace_odd_spaces(line).replace(",", " ").split()
        stamp, gravity = parse_timestamp(first), torch.tensor([float(x), float(y), float(z)], dtype=torch.float64)
        if not math.isfinite(stamp) or not abs(float(gravity.norm()) - 1) < _MAX_NORM_ERROR:
            raise ValueError
    except ValueError as error:
        raise InputError(f"{path}: is not a direction of gravity; copy it again, {expected}, or remove it") from error
    if abs(stamp - first_stamp) > _MAX_STAMP_ERROR:
        _LOG.warning("%s: is of the frame at %.6f s, not of the first one; gravity is not used", path, stamp)
        return None
    return normalize(gravity, dim=0)
