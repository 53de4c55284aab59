"""Depth images in files: 16-bit images, and depth in metres as floating-point TIFF, NumPy array or OpenEXR."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Callable
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

_EXR_HEADER_LENGTH = 1 << 16
"""Number of bytes that are searched for the size of an OpenEXR image; the header of a depth image is much shorter."""


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
    _check_exr_size(path)
    try:
        library = importlib.import_module("OpenEXR")
    except ImportError as error:
        raise InputError(f"{path}: reading OpenEXR needs a library ({error}); run pip install OpenEXR") from error
    try:
        with library.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # the library raises RuntimeError and ValueError on invalid data
        raise InputError(f"{path}: is truncated or damaged; copy or download it again") from error
    # A layer is part of the name, as in "ViewLayer.Depth.Z".
    found = (pixels for wanted in _EXR_CHANNELS for name, pixels in channels.items() if name.split(".")[-1] == wanted)
    depth = next(found, None)
    if depth is None:
        raise InputError(f"{path}: has the channels {', '.join(channels)}; export depth, in metres, as the channel Z")
    return np.asarray(depth)


def _check_exr_size(path: Path) -> None:
    """Check the size of an OpenEXR image by its header, because the library loads all pixels at once."""
    try:
        with path.open("rb") as file:
            header = file.read(_EXR_HEADER_LENGTH)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its name and permissions") from error
    _, found, window = header.partition(b"dataWindow\0box2i\0" + struct.pack("<i", 16))
    if not found or len(window) < 16:
        raise InputError(f"{path}: is truncated or not an OpenEXR image; copy or export it again")
    left, top, right, bottom = struct.unpack("<4i", window[:16])
    if (right - left + 1) * (bottom - top + 1) > MAX_PIXELS:
        raise too_large_error(path)


_READERS: dict[str, Callable[[Path], NDArray[np.generic]]] = {".npy": _read_npy, ".exr": _read_exr}
"""Readers of formats that Pillow does not read, by suffix."""
