"""Extraction of downloaded tar archives: confined to the target folder, bounded in size, and atomic."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
from collections.abc import Iterator
from errno import EEXIST, EISDIR, ENAMETOOLONG, ENOTDIR
from pathlib import Path
from typing import Self

from v3d_torch.errors import InputError, OutputError
from v3d_torch.io.text import first_line

MAX_BYTES = 20 * 2**30
"""Largest total size of the files in an archive, bytes: three times the largest TUM sequence."""

_MAX_MEMBERS = 1_000_000
"""Maximum number of members: many empty files can also fill a file system, and no sequence has a million files."""

_MAX_HEADER_BYTES = 1 << 20
"""Maximum size of the extension header of a member, bytes: tarfile reads it as a whole, and it contains only a name."""

_EXTENSION_HEADERS = (
    tarfile.GNUTYPE_LONGNAME,
    tarfile.GNUTYPE_LONGLINK,
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
    tarfile.SOLARIS_XHDTYPE,
)
"""Types of extension headers: long names, and PAX records."""

_CHUNK_SIZE = 1 << 20

_ERRORS_OF_NAMES = (ENAMETOOLONG, ENOTDIR, EISDIR, EEXIST)
"""Error numbers of archives with impossible names, or with two members of one name."""


def extract_tar(archive: Path, folder: Path, *, max_bytes: int = MAX_BYTES) -> None:
    """Extract a tar archive (any compression) so that ``folder`` appears complete or not at all.

    If the archive contains only one top-level folder, its contents become the contents of ``folder``.

    Args:
        archive: Archive to extract.
        folder: Folder to create; must not exist.
        max_bytes: Largest total size of the extracted files, bytes.

    Raises:
        InputError: If the archive is damaged, too large, or contains links, special files or paths that lead outside.
        OutputError: If the folder exists or cannot be written.
    """
    if folder.exists():
        raise OutputError(f"{folder}: already exists; remove it to extract {archive.name} again")
    scratch: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Next to the target, so that the final rename stays on one file system.
        scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        with tarfile.open(archive, tarinfo=_StrictTarInfo) as tar:
            tar.extractall(scratch, members=_limit_members(tar, archive, max_bytes), filter="data")
            _read_to_end(tar, max_bytes)
        _top_folder(scratch).replace(folder)
    except InputError:
        raise
    except tarfile.FilterError as error:
        cause = f"a member leads outside or is not a plain file ({error})"
        raise InputError(f"{archive}: is unsafe, {cause}; get it from another source") from error
    except Exception as error:  # each compression raises its own errors, some of them OSError without errno
        if isinstance(error, OSError) and error.errno not in (None, *_ERRORS_OF_NAMES):
            raise OutputError(
                f"{folder}: cannot be extracted ({error.strerror}); choose another --data-root"
            ) from error
        cause = first_line(error).removesuffix(":")
        raise InputError(f"{archive}: is not a complete tar archive ({cause}); download it again") from error
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


def _limit_members(tar: tarfile.TarFile, archive: Path, max_bytes: int) -> Iterator[tarfile.TarInfo]:
    """Yield the members; raise at a link, and before their total size or number exceeds the limit.

    All links are rejected, because the filter of Python before 3.11.13 and 3.12.11 lets a chain of links with a long
    path lead outside. No sequence has links.
    """
    total = 0
    for count, member in enumerate(tar):
        total += member.size
        if total > max_bytes or count >= _MAX_MEMBERS:
            limit = f"{max_bytes} bytes" if total > max_bytes else f"{_MAX_MEMBERS} files"
            raise InputError(f"{archive}: is unsafe, it extracts to more than {limit}; get it from another source")
        if member.issym() or member.islnk():
            raise tarfile.SpecialFileError(member)
        yield member


def _read_to_end(tar: tarfile.TarFile, max_bytes: int) -> None:
    """Read the rest of the archive: gzip, bzip2 and xz verify their checksums only at the end."""
    remaining = max_bytes
    while remaining > 0 and tar.fileobj is not None and (chunk := tar.fileobj.read(_CHUNK_SIZE)):
        remaining -= len(chunk)


class _StrictTarInfo(tarfile.TarInfo):
    """Member header that raises an error if it is damaged or too large; tarfile would treat it as the end."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        try:
            header = super().frombuf(buf, encoding, errors)
        except (tarfile.EmptyHeaderError, tarfile.EOFHeaderError):  # type: ignore[attr-defined]  # regular end
            raise
        except tarfile.HeaderError as error:
            raise tarfile.ReadError(str(error)) from error
        if header.type in _EXTENSION_HEADERS and header.size > _MAX_HEADER_BYTES:
            raise tarfile.ReadError(f"a header of {header.size} bytes")
        return header


def _top_folder(scratch: Path) -> Path:
    """Return the only entry of ``scratch`` if it is a folder, else ``scratch`` itself."""
    entries = list(scratch.iterdir())
    return entries[0] if len(entries) == 1 and entries[0].is_dir() else scratch
