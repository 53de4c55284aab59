"""Unpacking of downloaded archives: nothing leaves the folder, nothing half-unpacked stays."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from v3d_torch.errors import InputError, OutputError

MAX_BYTES = 20 * 2**30
"""Most bytes that an archive may unpack to: three times the largest TUM sequence."""


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
        with tarfile.open(archive) as tar:
            tar.extractall(scratch, members=_limited(tar, archive, max_bytes), filter="data")
        _top(scratch).replace(folder)
    except tarfile.FilterError as error:
        raise InputError(f"{archive}: is refused, a member leads outside or is no plain file ({error})") from error
    except (tarfile.TarError, EOFError, zlib.error) as error:
        raise InputError(f"{archive}: is not a whole tar archive ({error}); download it again") from error
    except OSError as error:
        raise OutputError(f"{folder}: cannot be unpacked ({error.strerror or error})") from error
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


def _limited(tar: tarfile.TarFile, archive: Path, max_bytes: int) -> Iterator[tarfile.TarInfo]:
    """The members, stopping with an error before more than ``max_bytes`` are written."""
    total = 0
    for member in tar:
        total += member.size
        if total > max_bytes:
            raise InputError(f"{archive}: is refused, it unpacks to more than {max_bytes} bytes")
        yield member


def _top(scratch: Path) -> Path:
    """The only folder in ``scratch``, else ``scratch`` itself."""
    entries = list(scratch.iterdir())
    return entries[0] if len(entries) == 1 and entries[0].is_dir() else scratch
