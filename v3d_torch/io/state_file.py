"""State as a file: Python objects and tensors in one graph, without code, and told apart from a damaged one.

A line with format, version and checksum, a line of JSON about the state, and an archive of ``torch.save``. Reading
makes objects of the classes that the reader names and of no others (``weights_only``): it runs no code of the file.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from pickle import UnpicklingError
from typing import IO, Any, cast

import torch

from v3d_torch.errors import InputError
from v3d_torch.io.files import atomic_write

_FORMAT, _VERSION = "v3d_torch state", 8

_HEADER = f"{_FORMAT} {{version}} sha256 {{digest}}\n"
_NO_DIGEST = "0" * hashlib.sha256().digest_size * 2

_BLOCK = 1 << 20

_DAMAGE = (UnpicklingError, RuntimeError, EOFError, ValueError, LookupError, TypeError, AttributeError, MemoryError)
"""What an archive and the objects in it raise when they are not what they should be."""


def write_state(path: Path, about: Mapping[str, Any], state: object) -> None:
    """Write a state whole or not at all; it stays also where the machine itself breaks down.

    Args:
        path: of the file.
        about: plain values that `read_state` gives back with the state.
        state: of tensors, containers and objects; objects that are shared in it are shared when it is read.

    Raises:
        OutputError: when the file cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(_HEADER.format(version=_VERSION, digest=_NO_DIGEST).encode())
        hashed = _Hashed(file)
        hashed.write(json.dumps({"v3d-torch": version("v3d-torch"), **about}).encode() + b"\n")
        torch.save(state, cast("IO[bytes]", hashed))  # it asks for no more than to write
        hashed.finish()
        file.seek(0)
        file.write(_HEADER.format(version=_VERSION, digest=hashed.digest).encode())
        file.flush()
        os.fsync(file.fileno())  # or a loss of power after the renaming leaves neither this state nor the one before


def read_state(path: Path, classes: Sequence[type]) -> tuple[dict[str, Any], Any]:
    """Read a state.

    Args:
        path: of a file that `write_state` wrote.
        classes: that objects in it may have, beside tensors and Python's plain ones.

    Returns:
        What was said about it, and the state.

    Raises:
        InputError: the file is not there, no state, damaged, or of another version of this program.
    """
    try:
        with path.open("rb") as file:
            _check(path, file)
            about = json.loads(file.readline())
            if about["v3d-torch"] != version("v3d-torch"):
                raise InputError(
                    f"{path}: was written by v3d-torch {about['v3d-torch']}, and this is {version('v3d-torch')}; go on"
                    " with that version, or begin anew"
                )
            with torch.serialization.safe_globals(list(classes)):
                return about, torch.load(file, weights_only=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check who may read it") from error
    except _DAMAGE as error:
        raise _damaged(path) from error


def _check(path: Path, file: IO[bytes]) -> None:
    """Raise InputError unless the rest of a file is as it was written; leave the file behind its first line."""
    match = re.fullmatch(rf"{_FORMAT} (\d+) sha256 ([0-9a-f]{{64}})\n", file.readline(200).decode("ascii", "replace"))
    if match is None:
        raise _damaged(path)
    if int(match[1]) != _VERSION:
        raise InputError(
            f"{path}: is a state in version {match[1]} of its format, of which this program knows version {_VERSION};"
            " go on with the program that wrote it, or begin anew"
        )
    begin, digest = file.tell(), hashlib.sha256()
    while block := file.read(_BLOCK):
        digest.update(block)
    if digest.hexdigest() != match[2]:
        raise _damaged(path)
    file.seek(begin)


def _damaged(path: Path) -> InputError:
    return InputError(f"{path}: is no state of a run, or a damaged one; begin anew")


class _Hashed:
    """Passes on what is written, and adds up its checksum.

    What is raised meanwhile is kept until `finish`: torch's archives make a RuntimeError of it that says nothing.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._digest = hashlib.sha256()
        self._error: BaseException | None = None

    def write(self, content: bytes) -> int:
        """Write all of it, or take no notice."""
        if self._error is None:
            try:
                self._file.write(content)
                self._digest.update(content)
            except BaseException as error:  # Ctrl-C among them
                self._error = error
        return len(content)

    def flush(self) -> None:
        """Nothing is held back."""

    def finish(self) -> None:
        """Raise the first error that there was."""
        if self._error is not None:
            raise self._error

    @property
    def digest(self) -> str:
        """Of all that was written."""
        return self._digest.hexdigest()
