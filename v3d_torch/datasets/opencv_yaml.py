"""YAML as OpenCV writes it, which YAML libraries refuse, and OpenCV itself reads with no care for broken files."""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3d_torch.errors import InputError
from v3d_torch.io.safe_yaml import parse_yaml
from v3d_torch.io.text import read_text

_DIALECT, _MATRIX = "%YAML:1.0", "!!opencv-matrix"
"""Its first line, which is no directive of YAML; and the tag of a matrix, which is a mapping."""


def read_opencv_yaml(path: Path) -> Any:
    """The value that a file stands for; a matrix in it is a mapping that `matrix` understands.

    Raises:
        InputError: it cannot be read or is no such file.
    """
    text = read_text(path, "it is YAML as OpenCV writes it")
    try:
        return parse_yaml(text.removeprefix(_DIALECT).replace(_MATRIX, ""))
    except ValueError as error:
        raise InputError(f"{path}: is no YAML as OpenCV writes it ({error}); copy it again") from error


def matrix(node: Any, *shape: int) -> NDArray[np.float64]:
    """The numbers of a matrix in a shape, row after row.

    Raises:
        ValueError: the node is no matrix of so many numbers.
    """
    data = node.get("data") if isinstance(node, dict) else None
    if not isinstance(data, list) or len(data) != prod(shape):
        raise ValueError(f"no matrix of {prod(shape)} numbers")
    # YAML takes 1e-05, which has no dot, for a word.
    return np.array([float(number) for number in data], dtype=np.float64).reshape(shape)
