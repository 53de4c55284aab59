"""Atomic writing of files, and locks between processes."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EISDIR
from pathlib import Path
from tempfile import TemporaryFile

import cv2
import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from v3d_torch.errors import OutputError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``, and rename it to ``path`` if the block succeeds.

    The temporary path is that of a new, empty file. It keeps the suffix, because some writers choose the format by
    suffix.

    Raises:
        OutputError: If the folder cannot be written or the disk is full.
    """
    # A name that nobody can predict: in a shared folder, another user could put a link to a file of this user there.
    temporary = path.with_name(f".{secrets.token_hex(8)}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise _unwritable_error(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _unwritable_error(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written ({error.strerror or error}); free the disk or choose another folder")


def check_writable(path: Path) -> None:
    """Make the folder of a file and check that the file can be written; call this before long work.

    Raises:
        OutputError: If the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(EISDIR, os.strerror(EISDIR))
        with TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another file") from error


def file_size(path: Path) -> int | None:
    """Return the size of a file, bytes; None if it cannot be read."""
    try:
        return path.stat().st_size
    except (OSError, ValueError):  # ValueError if the name has a null character
        return None


def check_empty_folder(folder: Path) -> None:
    """Check that a folder is new or empty, so that no file is overwritten or mixed with others.

    Raises:
        OutputError: If the folder contains files.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: already exists and is not an empty folder; choose another folder with --out")


@contextmanager
def emptied_on_failure(folder: Path) -> Iterator[None]:
    """Remove everything from a folder if the block fails or is interrupted, and the folder if it was missing before.

    Args:
        folder: Folder that is new or empty, see `check_empty_folder`.
    """
    is_new = not folder.exists()
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for path in folder.iterdir():
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink()
            if is_new:
                folder.rmdir()
        raise


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically; bytes in names that are not UTF-8 become escapes.

    Raises:
        OutputError: As `atomic_write`.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def append_line(path: Path, line: str) -> None:
    """Append a line to a UTF-8 text file, which is made if it is missing.

    Raises:
        OutputError: As `atomic_write`.
    """
    try:
        with path.open("a", encoding="utf-8", newline="\n") as file:
            file.write(f"{line}\n")
    except OSError as error:
        raise _unwritable_error(path, error) from error


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write a PNG file atomically.

    Args:
        path: File to write.
        image: Grey image of shape (H, W), uint8 or uint16, or RGB image of shape (H, W, 3), uint8.

    Raises:
        OutputError: As `atomic_write`.
    """
    encoded = cv2.imencode(".png", image if image.ndim == 2 else image[..., ::-1])[1]
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


@contextmanager
def file_lock(target: Path) -> Iterator[None]:
    """Lock a file or folder against other processes that want to create it.

    Another process can have created the target while this one waited: check for the target inside the block.

    Raises:
        OutputError: If the folder cannot be written.
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
