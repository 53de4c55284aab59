"""Where a sequence is: given, among the user's data, in the cache, or to be downloaded."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from v3d_torch.datasets.names import canonical_name, download_url, short_name, unknown_name
from v3d_torch.datasets.tum import is_tum
from v3d_torch.errors import DownloadError, InputError
from v3d_torch.io.download import Progress, cache_dir, fetch
from v3d_torch.io.extract import extract_tar
from v3d_torch.io.files import file_lock
from v3d_torch.io.paths import expand_user


def sequence_path(name: str, *, data_root: Path | None, download: bool, progress: Progress | None) -> Path:
    """The folder or file of a sequence.

    Looked for in this order: ``name`` as a folder or file; in ``data_root``, else ``$V3D_DATA``; in the cache
    (`v3d_torch.io.download.cache_dir`). In the latter two a folder may be called by any name of the sequence. Last, a TUM
    sequence is downloaded into ``data_root`` where it is given, else into the cache; ``$V3D_DATA`` is only read, it may
    be shared.

    Raises:
        InputError: no such folder or file and no such sequence.
        DownloadError: the sequence is not here and cannot be downloaded; the message says how to get it by hand.
    """
    if not name:
        raise InputError("the name of the sequence is empty; give a name, a folder or a file")
    if (found := stored_path(name, data_root)) is not None:
        return found
    full_name, search = canonical_name(name), data_folder(data_root)
    if full_name is None:
        raise unknown_name(name)
    put = f"by hand, unpack it and put the folder {full_name} into {search}"
    if not download:
        raise InputError(f"{short_name(full_name)} is not in {search}; get {download_url(full_name)} {put}")
    try:
        return _download(full_name, data_root or cache_dir(), progress)
    except DownloadError as error:
        raise DownloadError(f"{short_name(full_name)} is not in {search}: {error}; get that file {put}") from error


def stored_path(name: str, data_root: Path | None) -> Path | None:
    """The folder or file of a sequence that is here, looked for as `sequence_path` does; None where there is none."""
    if (path := expand_user(name)).exists():
        return path
    found = (_find(root, name, canonical_name(name)) for root in (data_folder(data_root), cache_dir()))
    return next((path for path in found if path is not None), None)


def data_folder(data_root: Path | None) -> Path:
    """Where sequences are kept: ``data_root`` if given, else ``$V3D_DATA``, else the cache."""
    shared = os.environ.get("V3D_DATA")
    return data_root or (expand_user(shared) if shared else cache_dir())


def _find(root: Path, name: str, full_name: str | None) -> Path | None:
    """What is called so under ``root``, or a folder that another name of the same sequence stands on."""
    if (root / name).exists():
        return root / name
    if full_name is None or not root.is_dir():
        return None
    folders = (entry for entry in sorted(root.iterdir()) if canonical_name(entry.name) == full_name)
    return next((folder for folder in folders if folder.is_dir()), None)


def _download(full_name: str, root: Path, progress: Progress | None) -> Path:
    folder, archive = root / full_name, root / f"{full_name}.tgz"
    with file_lock(cache_dir() / full_name):  # in the cache: the data may be on a file system without locks
        if not folder.is_dir():
            fetch(download_url(full_name), archive, progress=progress)
            try:
                extract_tar(archive, folder)
            finally:
                archive.unlink()
            if not is_tum(folder):
                shutil.rmtree(folder)  # or it would be taken for the sequence from now on
                raise InputError(f"{archive}: holds no rgb.txt and depth.txt; get the archive from another source")
    return folder
