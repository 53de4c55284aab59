"""Text that is read, and files that are written whole or not at all and by one process at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EISDIR
from pathlib import Path
from tempfile import TemporaryFile

import cv2
import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from v3d_torch.errors import InputError, OutputError

StrPath = str | os.PathLike[str]
"""A path as users of the library write it."""

_MAX_LENGTH = 100 << 20
"""Letters: a trajectory of an hour at 200 Hz has fewer, and a device that never ends has more."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Give a temporary name beside ``path`` to write to, and rename it to ``path`` when the block ends well.

    The temporary name keeps the suffix, by which some writers choose the format.

    Raises:
        OutputError: when the folder cannot be written or the disk is full.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); free the disk or choose another folder"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Make the folder of a file that is to be written after long work, and see whether it could be, before that.

    Raises:
        OutputError: when it could not.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(EISDIR, os.strerror(EISDIR))
        with TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); give another file") from error


def read_text(path: Path, expected: str) -> str:
    """Read UTF-8 text, with or without a byte order mark, and with any line ends, which become those of Unix.

    Args:
        path: of the file.
        expected: what the file should hold, for the message: "a trajectory has lines of ...".

    Raises:
        InputError: when the file cannot be read, is not text or larger than any such file is.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            text = file.read(_MAX_LENGTH + 1)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check that it is a file and who may read it"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a text file in UTF-8; convert it to that, {expected}") from error
    if len(text) > _MAX_LENGTH:
        raise InputError(f"{path}: is larger than {_MAX_LENGTH >> 20} MB; {expected}")
    return text


def numbered_lines(path: Path, expected: str) -> Iterator[tuple[int, str]]:
    """Lines of a text file that hold something, without comments (#), with their numbers from 1; see `read_text`."""
    for number, line in enumerate(read_text(path, expected).split("\n"), start=1):
        if (line := line.strip()) and not line.startswith("#"):
            yield number, line


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text whole or not at all.

    Raises:
        OutputError: see :func:`atomic_write`.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an 8-bit image, shape (H, W) or (H, W, 3) RGB, whole or not at all.

    Raises:
        OutputError: see :func:`atomic_write`.
    """
    encoded = cv2.imencode(".png", image if image.ndim == 2 else image[..., ::-1])[1]
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


@contextmanager
def file_lock(target: Path) -> Iterator[None]:
    """Let other processes that want to make the same file or folder wait; they should look again whether it is there.

    Raises:
        OutputError: when the folder cannot be written.
    """
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror}); set V3D_CACHE to another folder") from error
    try:
        yield
    finally:
        lock.release()
