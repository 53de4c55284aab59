"""Search for sequences: the given path, the user's data, the cache, and download as the last resort."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from v3d_torch.datasets.sequence_names import (
    BUILT_IN_SEQUENCES,
    canonical_name,
    download_url,
    short_name,
    unknown_name_error,
)
from v3d_torch.errors import DownloadError, InputError
from v3d_torch.io.download import Progress, fetch
from v3d_torch.io.extract import extract_tar
from v3d_torch.io.files import file_lock
from v3d_torch.io.paths import cache_dir, expand_user


def find_or_download(name: str, *, data_root: Path | None, download: bool, progress: Progress | None) -> Path:
    """Find the folder or file of a sequence, or download the sequence.

    The search order is: ``name`` as a path; ``data_root``, or else ``$V3D_DATA``; the cache
    (`v3d_torch.io.paths.cache_dir`). In the last two, a folder can have any spelling of the name. A missing TUM
    sequence is downloaded to ``data_root`` if given, or else to the cache. ``$V3D_DATA`` can be shared and is never
    written to.

    Args:
        name: Path or name of the sequence.
        data_root: Folder with the user's sequences; None for ``$V3D_DATA``.
        download: True if a missing TUM sequence is downloaded.
        progress: Callback for the number of bytes downloaded; None for no reports.

    Returns:
        Path of the folder or file.

    Raises:
        InputError: If there is no such path and no such sequence.
        DownloadError: If the download fails. The message explains how to download the sequence manually.
    """
    if not name:
        raise InputError("the sequence name is empty; pass a name, a folder or a file")
    if (found := find_stored(name, data_root)) is not None:
        return found
    full_name, folder = canonical_name(name), data_folder(data_root)
    if full_name is None:
        raise unknown_name_error(name, _stored_folders(name, data_root))
    install = f"unpack it and move the folder {full_name} to {folder}"
    if not download:
        raise InputError(f"{short_name(full_name)}: is not in {folder}; download {download_url(full_name)}, {install}")
    try:
        return _download(full_name, data_root or cache_dir(), progress)
    except DownloadError as error:
        raise DownloadError(
            f"{short_name(full_name)}: is not in {folder} and its download failed ({error}); download it manually,"
            f" {install}"
        ) from error


def is_tum(path: Path) -> bool:
    """Check whether a folder has any list of the TUM layout. Opening the sequence reports missing ones."""
    return any((path / name).is_file() for name in ("associations.txt", "rgb.txt", "depth.txt"))


def check_name(name: str, data_root: Path | None) -> None:
    """Reject a name that is not a source, before libraries are imported to open it.

    Args:
        name: Name as in `open_source`.
        data_root: Folder with the user's sequences; None for ``$V3D_DATA``.

    Raises:
        InputError: If there is no such path and no such sequence.
    """
    with suppress(OSError):  # such as a name that is too long; `open_source` reports the error
        if not _is_special(name) and canonical_name(name) is None and find_stored(name, data_root) is None:
            raise unknown_name_error(name, _stored_folders(name, data_root))


def find_stored(name: str, data_root: Path | None) -> Path | None:
    """Path of a sequence that is already on disk, with the search order of `find_or_download`; None if not found."""
    if (path := expand_user(name)).exists():
        return path
    found = (_find(root, name, canonical_name(name)) for root in (data_folder(data_root), cache_dir()))
    return next((path for path in found if path is not None), None)


def identify(name: str, data_root: Path | None) -> Path | str:
    """Return what all spellings of one sequence have in common: its path if it is on disk, or else its full name.

    Args:
        name: Name as in `open_source`.
        data_root: Folder with the user's sequences; None for ``$V3D_DATA``.

    Raises:
        OSError: If the name is too long, or if a folder cannot be read.
    """
    stored = None if _is_special(name) else find_stored(name, data_root)
    return stored.resolve() if stored is not None else canonical_name(name) or name


def data_folder(data_root: Path | None) -> Path:
    """Folder with the user's sequences: ``data_root`` if given, or else ``$V3D_DATA``, or else the cache."""
    shared = os.environ.get("V3D_DATA")
    return data_root or (expand_user(shared) if shared else cache_dir())


def data_root_of(name: str, data_root: Path | None) -> Path | None:
    """Folder of named sequences that opens the same sequence again, without the environment of this process.

    Args:
        name: Name of the source as in `open_source`.
        data_root: Folder with the user's sequences; None for ``$V3D_DATA``.

    Returns:
        ``data_root`` if given, or else ``$V3D_DATA`` if the sequence is found there, absolute; None otherwise.
    """
    if data_root is None and os.environ.get("V3D_DATA") and not _is_special(name):
        with suppress(OSError):  # such as a name that is too long; `open_source` reports the error
            shared = data_folder(None)
            if not expand_user(name).exists() and _find(shared, name, canonical_name(name)) is not None:
                data_root = shared
    return None if data_root is None else data_root.absolute()


def is_live(name: str) -> bool:
    """Check whether a name is that of a live camera."""
    return name.partition(":")[0] == "realsense"


def _is_special(name: str) -> bool:
    """Check whether a name is empty or that of a source that is not on disk."""
    return name in ("", *BUILT_IN_SEQUENCES) or is_live(name)


def _find(root: Path, name: str, full_name: str | None) -> Path | None:
    """Find an entry of ``root`` by its name, or a folder by another name of the same TUM sequence."""
    if (root / name).exists():
        return root / name
    if full_name is None or not root.is_dir():
        return None
    folders = (entry for entry in sorted(root.iterdir()) if canonical_name(entry.name) == full_name)
    return next((folder for folder in folders if folder.is_dir()), None)


def _stored_folders(name: str, data_root: Path | None) -> list[str]:
    """Return the paths of the folders beside a path, and the names of those with the user's sequences."""
    folders: list[str] = []
    for root, prefix in ((expand_user(name).parent, Path(name).parent), (data_folder(data_root), Path())):
        with suppress(OSError):  # there is no such folder, or it cannot be read
            folders += [str(prefix / entry.name) for entry in sorted(root.iterdir()) if entry.is_dir()]
    return folders


def _download(full_name: str, root: Path, progress: Progress | None) -> Path:
    folder, archive = root / full_name, root / f"{full_name}.tgz"
    # The lock is in the cache, because the file system of the data may not support locks.
    with file_lock(cache_dir() / full_name):
        if not folder.is_dir():
            if not archive.is_file():  # it is left if there was no space to extract it
                fetch(download_url(full_name), archive, progress=progress)
            try:
                extract_tar(archive, folder)
            except InputError:
                archive.unlink()
                raise
            archive.unlink()
            if not is_tum(folder):
                shutil.rmtree(folder)  # otherwise the next search finds this folder
                raise InputError(f"{archive}: contains no rgb.txt and depth.txt; get the archive from another source")
    return folder
