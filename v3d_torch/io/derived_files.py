"""Files that are computed from other files, and kept with their digests, so that a damaged file is not used."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from v3d_torch.io.files import atomic_write, file_lock, write_text


def derive(targets: Sequence[Path], write: Callable[..., None]) -> None:
    """Write files, unless all of them exist as they were written.

    The digest of each file is in a hidden file beside it. A file without a digest is written again.

    Args:
        targets: Files, in one folder.
        write: Function that writes all files; its arguments are the paths to write, one for each target.

    Raises:
        OutputError: If the folder cannot be written or the disk is full.
    """
    if all(map(_is_intact, targets)):
        return
    with file_lock(targets[0]):
        if all(map(_is_intact, targets)):  # another process has written them
            return
        with ExitStack() as drafts:
            write(*[drafts.enter_context(atomic_write(target)) for target in targets])
        for target in targets:
            write_text(_digest_file(target), _digest(target))


def _is_intact(target: Path) -> bool:
    """Check whether a file has the digest with which it was written."""
    try:
        return _digest_file(target).read_bytes() == _digest(target).encode()
    except OSError:  # one of the two is missing, or cannot be read
        return False


def _digest(target: Path) -> str:
    with target.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest_file(target: Path) -> Path:
    return target.with_name(f".{target.name}.sha256")
