"""Depth images in files: 16-bit images, and depth in metres as floating-point TIFF, NumPy array or OpenEXR."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.images import is_depth_image, read_depth_image, too_large_error
from v3d_torch.errors import InputError
from v3d_torch.io.image_file import MAX_PIXELS

DEPTH_SUFFIXES = frozenset({".npy", ".exr"})
"""Suffixes of files, in lower case, that can only be depth images."""

_EXR_CHANNELS = ("Z", "Y", "V", "R")
"""Channels of an OpenEXR file that can contain depth, as renderers write it: depth, brightness, value, red. The first
channel that exists is read."""

_MAX_EXR_VALUES = 2 * MAX_PIXELS
"""Maximum number of values in all channels of an OpenEXR file: half a gigabyte in 32 bits."""


def read_depth_file(path: Path) -> NDArray[np.generic]:
    """Read a depth image from a file of any supported format.

    Args:
        path: 16-bit image, floating-point TIFF, ``.npy`` or ``.exr``.

    Returns:
        Whole numbers in units of the file, or metres in floating point, shape (H, W).

    Raises:
        InputError: If the file is missing, truncated, too large, or not a depth image.
    """
    return _READERS.get(path.suffix.lower(), read_depth_image)(path)


def is_depth_file(path: Path) -> bool:
    """Check whether a file is a depth image of any supported format. Only its name or its header is read."""
    return path.suffix.lower() in DEPTH_SUFFIXES or is_depth_image(path)


def _read_npy(path: Path) -> NDArray[np.generic]:
    try:
        array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")  # reads only the header, never unpickles
    except OSError as error:
        if error.errno is None:
            raise InputError(f"{path}: is not a NumPy array; copy or export it again") from error
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its name and permissions") from error
    except Exception as error:  # a damaged header can raise any exception
        raise InputError(f"{path}: is truncated or not a NumPy array; copy or export it again") from error
    if array.size > MAX_PIXELS:
        raise too_large_error(path)
    if array.squeeze().ndim != 2 or array.dtype.kind not in "fiu" or array.dtype == np.uint8:
        raise InputError(
            f"{path}: is a NumPy array of {array.dtype} with shape {array.shape}, not a depth image; save depth with"
            " shape (H, W), as float32 in metres or as uint16"
        )
    return np.array(array.squeeze())


def _read_exr(path: Path) -> NDArray[np.generic]:
    try:
        with path.open("rb"):
            pass  # the library does not tell why it cannot open a file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its name and permissions") from error
    try:
        library = importlib.import_module("OpenEXR")
    except ImportError as error:
        raise InputError(f"{path}: reading OpenEXR needs a library ({error}); run pip install OpenEXR") from error
    try:
        with library.File(str(path), header_only=True) as file:
            parts = [(part.header["dataWindow"], len(part.header["channels"])) for part in file.parts]
    except Exception as error:  # the library raises RuntimeError and ValueError on invalid data
        raise InputError(f"{path}: is truncated or not an OpenEXR image; copy or export it again") from error
    _check_exr_size(path, parts)
    try:
        with library.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:
        raise InputError(f"{path}: is truncated or damaged; copy or download it again") from error
    # A layer is part of the name, as in "ViewLayer.Depth.Z".
    found = (pixels for wanted in _EXR_CHANNELS for name, pixels in channels.items() if name.split(".")[-1] == wanted)
    depth = next(found, None)
    if depth is None:
        raise InputError(f"{path}: has the channels {', '.join(channels)}; export depth, in metres, as the channel Z")
    return np.asarray(depth)


def _check_exr_size(path: Path, parts: Sequence[tuple[NDArray[np.int32], int]]) -> None:
    """Check the size of an OpenEXR image, because the library loads all channels of all parts at once.

    Args:
        path: Path of the image.
        parts: For each part, its first and last column and row, shape (2, 2), and its number of channels.
    """
    values = 0
    for window, channels in parts:
        (left, top), (right, bottom) = np.asarray(window).tolist()
        pixels = (right - left + 1) * (bottom - top + 1)
        if pixels > MAX_PIXELS:
            raise too_large_error(path)
        values += pixels * channels
    if values > _MAX_EXR_VALUES:
        raise InputError(
            f"{path}: has more than {_MAX_EXR_VALUES >> 20} million values in its channels; export depth alone, in"
            " metres, as the channel Z"
        )


_READERS: dict[str, Callable[[Path], NDArray[np.generic]]] = {".npy": _read_npy, ".exr": _read_exr}
"""Readers of formats that Pillow does not read, by suffix."""
