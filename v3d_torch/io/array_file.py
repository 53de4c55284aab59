"""Array files: named arrays and a description in a zip archive of NumPy (npz), read without running code from it."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3d_torch.errors import InputError
from v3d_torch.io.files import atomic_write

_MIN_UNPACKED_LIMIT = 1 << 28
"""Number of bytes to which a file of any size may unpack."""

_MAX_UNPACKED_RATIO = 20
"""Additional bytes to which a file may unpack, relative to its size. Maps unpack to about three times their size."""

_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Kinds of compression that NumPy writes."""

_DAMAGE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    RuntimeError,
    OverflowError,
    MemoryError,
    SyntaxError,
    TokenError,
)
"""Errors of zip archives, arrays and JSON with wrong or missing bytes."""


@dataclass(frozen=True)
class ArrayFile:
    """Open array file.

    Attributes:
        about: Description of the content.
    """

    about: dict[str, Any]
    _archive: zipfile.ZipFile

    def __contains__(self, name: str) -> bool:
        return f"{name}.npy" in self._archive.namelist()

    def read(self, name: str) -> NDArray[Any]:
        """Read an array; its checksum is verified.

        Raises:
            KeyError: If there is no array of this name.
        """
        return _read_array(self._archive, name)


def write_array_file(path: Path, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write an array file. Equal content gives identical files.

    Args:
        path: Path of the file, with any suffix.
        about: Description of the content, as for JSON, with its ``format`` and ``version``.
        arrays: Arrays without Python objects, by name.

    Raises:
        OutputError: If the file cannot be written.
    """
    described: dict[str, Any] = {"about": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8), **arrays}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **described)


@contextmanager
def open_array_file(path: Path, format_name: str, kind: str, fix: str) -> Iterator[ArrayFile]:
    """Open an array file for reading; errors in the block that damage causes become `InputError`.

    Args:
        path: Path of the file.
        format_name: Format that the description must have.
        kind: Kind of file, for error messages.
        fix: Fix for a wrong file, for error messages.

    Raises:
        InputError: If the file is missing, of another format, or damaged.
    """
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            _check_members(archive, path.stat().st_size)
            about = json.loads(_read_array(archive, "about").tobytes())
            if about["format"] != format_name:
                raise ValueError(f"its format is not {format_name!r}")
            yield ArrayFile(about, archive)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {fix}") from error
    except _DAMAGE_ERRORS as error:
        raise InputError(f"{path}: is not {kind} or is damaged ({error}); {fix}") from error


def _check_members(archive: zipfile.ZipFile, size: int) -> None:
    """Raise ValueError if NumPy did not write an archive, or its ``size`` bytes would unpack to far more than a map."""
    if any(member.compress_type not in _COMPRESSIONS for member in archive.infolist()):
        raise ValueError("it has another compression than deflate")
    unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > _MIN_UNPACKED_LIMIT + _MAX_UNPACKED_RATIO * size:
        raise ValueError(f"it would unpack to {unpacked} bytes from {size}")


def _read_array(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    return np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False)
