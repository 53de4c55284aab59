"""State files: Python objects and tensors in one file, verified by a checksum and loaded without running code.

A file has three parts: a line with format, version and checksum; a line of JSON metadata; an archive of
``torch.save``. Loading creates objects of the classes that the caller allows and of no others (``weights_only``).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, cast

import torch

from v3d_torch.errors import InputError, OutputError
from v3d_torch.io.files import atomic_write

_FORMAT = "v3d_torch state"

VERSION = 43
"""Version of the content of states. A state of another version is rejected."""

_FIRST_LINE = f"{_FORMAT} {{version}} sha256 {{digest}}\n"
_PLACEHOLDER_DIGEST = "0" * hashlib.sha256().digest_size * 2

_BLOCK_SIZE = 1 << 20


def write_state(path: Path, metadata: Mapping[str, Any], state: object, classes: Sequence[type] | None = None) -> None:
    """Write a state file atomically and durably: after a power failure the file contains the old or the new state.

    Args:
        path: File to write.
        metadata: Plain values that `read_state` returns next to the state.
        state: Tensors, containers and objects; objects that are shared stay shared after loading.
        classes: Classes with which it will be read, see `read_state`; None to write any others, too.

    Raises:
        OutputError: If the file cannot be written, or has objects of other classes.
    """
    with atomic_write(path) as temporary, temporary.open("w+b") as file:
        file.write(_FIRST_LINE.format(version=VERSION, digest=_PLACEHOLDER_DIGEST).encode())
        hashed = _HashingWriter(file)
        hashed.write(json.dumps({"v3d-torch": version("v3d-torch"), **metadata}).encode() + b"\n")
        torch.save(state, cast("IO[bytes]", hashed))  # torch.save only calls write and flush
        hashed.raise_error()
        if classes is not None:
            _check_classes(path, file, classes)
        file.seek(0)
        file.write(_FIRST_LINE.format(version=VERSION, digest=hashed.digest).encode())
        file.flush()
        os.fsync(file.fileno())  # the rename can reach the disk before the content otherwise


def _check_classes(path: Path, file: IO[bytes], classes: Sequence[type]) -> None:
    """Raise OutputError if a state file has objects that cannot be read with these classes."""
    file.seek(0)
    file.readline(), file.readline()
    with torch.serialization.safe_globals(list(classes)):
        others = torch.serialization.get_unsafe_globals_in_checkpoint(file)
    if others:
        raise OutputError(
            f"{path}: the state has objects that cannot be loaded again ({', '.join(sorted(others))}); let the"
            " state_dict of stages return tensors, numbers and texts, and lists and dictionaries of them"
        )


def read_state(path: Path, classes: Sequence[type]) -> tuple[dict[str, Any], Any]:
    """Read a state file.

    Args:
        path: File that `write_state` wrote.
        classes: Classes of the objects in the state, except tensors and Python's plain types.

    Returns:
        The metadata and the state.

    Raises:
        InputError: If the file is missing, damaged, not a state file, or written by another version of this program.
    """
    try:
        with path.open("rb") as file:
            _verify(path, file)
            metadata = json.loads(file.readline())
            if metadata["v3d-torch"] != version("v3d-torch"):
                raise InputError(
                    f"{path}: was written by v3d-torch {metadata['v3d-torch']}, this is {version('v3d-torch')}; "
                    "continue with that version, or start a new run"
                )
            with torch.serialization.safe_globals(list(classes)):
                return metadata, torch.load(file, weights_only=True)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    except Exception as error:  # damaged objects can raise any exception
        raise _damage_error(path) from error


def _verify(path: Path, file: IO[bytes]) -> None:
    """Check format, version and checksum; leave the file positioned after its first line."""
    match = re.fullmatch(rf"{_FORMAT} (\d+) sha256 ([0-9a-f]{{64}})\n", file.readline(200).decode("ascii", "replace"))
    if match is None:
        raise _damage_error(path)
    if int(match[1]) != VERSION:
        raise InputError(
            f"{path}: has state format {match[1]}, this program reads format {VERSION}; continue with the program"
            " that wrote it, or start a new run"
        )
    start, digest = file.tell(), hashlib.sha256()
    while block := file.read(_BLOCK_SIZE):
        digest.update(block)
    if digest.hexdigest() != match[2]:
        raise _damage_error(path)
    file.seek(start)


def _damage_error(path: Path) -> InputError:
    return InputError(f"{path}: is damaged or not a state of a run; start a new run")


class _HashingWriter:
    """Writable file object that passes data on and computes its checksum.

    An error while writing is stored until `raise_error`, because torch replaces errors of its output file by a
    RuntimeError without the cause.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._digest = hashlib.sha256()
        self._error: BaseException | None = None

    def write(self, content: bytes) -> int:
        """Write all of the content; do nothing after an error."""
        if self._error is None:
            try:
                self._file.write(content)
                self._digest.update(content)
            except BaseException as error:  # also KeyboardInterrupt
                self._error = error
        return len(content)

    def flush(self) -> None:
        """Do nothing: this object has no buffer."""

    def raise_error(self) -> None:
        """Raise the first error that occurred while writing, if any."""
        if self._error is not None:
            raise self._error

    @property
    def digest(self) -> str:
        """SHA-256 checksum of all content written so far, hexadecimal."""
        return self._digest.hexdigest()
