"""Unpacking of downloaded archives: nothing leaves the folder, nothing half-unpacked stays."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Self

from v3d_torch.errors import InputError, OutputError

MAX_BYTES = 20 * 2**30
"""Most bytes that an archive may unpack to: three times the largest TUM sequence."""

_MAX_MEMBERS = 1_000_000
"""Most files, also empty ones: a file system has room for so many names, and no sequence has."""

_MAX_HEADER = 1 << 20
"""Most bytes of a header before a member, which is read into memory as a whole: it holds a name."""

_NAMES = (
    *(tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK),
    *(tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE),
)
"""Kinds of such headers."""

_CHUNK = 1 << 20


def extract_tar(archive: Path, folder: Path, *, max_bytes: int = MAX_BYTES) -> None:
    """Unpack a tar archive (any compression) so that ``folder`` appears whole or not at all.

    When all that is in the archive lies in one top folder, that folder's contents become ``folder``'s.

    Args:
        archive: file to unpack.
        folder: folder to make; must not exist.
        max_bytes: refuse archives that unpack to more.

    Raises:
        InputError: the archive is broken, holds paths or links that lead outside, special files, or too much.
        OutputError: the folder exists or cannot be written.
    """
    if folder.exists():
        raise OutputError(f"{folder}: is already there; remove it to unpack {archive.name} again")
    scratch: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Beside the target, so that the rename at the end stays on one file system.
        scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        with tarfile.open(archive, tarinfo=_Header) as tar:
            tar.extractall(scratch, members=_limited(tar, archive, max_bytes), filter="data")
            _read_to_the_end(tar, max_bytes)
        _top(scratch).replace(folder)
    except InputError:
        raise
    except tarfile.FilterError as error:
        why = "a member leads outside or is no plain file"
        raise InputError(f"{archive}: is refused, {why} ({error}); get it from another source") from error
    except Exception as error:  # every compression has its own, some of which are an OSError without a number
        if isinstance(error, OSError) and error.errno is not None:
            raise OutputError(f"{folder}: cannot be unpacked ({error.strerror}); choose another --data-root") from error
        why = (str(error).splitlines() or [type(error).__name__])[0].removesuffix(":")
        raise InputError(f"{archive}: is not a whole tar archive ({why}); download it again") from error
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


def _limited(tar: tarfile.TarFile, archive: Path, max_bytes: int) -> Iterator[tarfile.TarInfo]:
    """The members, stopping with an error before more than ``max_bytes`` are written."""
    total = 0
    for count, member in enumerate(tar):
        total += member.size
        if total > max_bytes or count >= _MAX_MEMBERS:
            most = f"{max_bytes} bytes" if total > max_bytes else f"{_MAX_MEMBERS} files"
            raise InputError(f"{archive}: is refused, it unpacks to more than {most}; get it from another source")
        yield member


def _read_to_the_end(tar: tarfile.TarFile, max_bytes: int) -> None:
    """Read what is behind the last member: only then do gzip and its like compare their checksum."""
    left = max_bytes
    while left > 0 and tar.fileobj is not None and (chunk := tar.fileobj.read(_CHUNK)):
        left -= len(chunk)


class _Header(tarfile.TarInfo):
    """A header that is broken, which `tarfile` takes for the end of the archive, or too large, is an error."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        try:
            header = super().frombuf(buf, encoding, errors)
        except (tarfile.EmptyHeaderError, tarfile.EOFHeaderError):  # type: ignore[attr-defined]  # the end
            raise
        except tarfile.HeaderError as error:
            raise tarfile.ReadError(str(error)) from error
        if header.type in _NAMES and header.size > _MAX_HEADER:
            raise tarfile.ReadError(f"a header of {header.size} bytes")
        return header


def _top(scratch: Path) -> Path:
    """The only folder in ``scratch``, else ``scratch`` itself."""
    entries = list(scratch.iterdir())
    return entries[0] if len(entries) == 1 and entries[0].is_dir() else scratch
