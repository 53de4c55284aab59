"""Folder of the results of a run: created by name or time, locked, cleared of an earlier run."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from errno import ENOLCK, ENOSYS, EOPNOTSUPP
from fnmatch import fnmatchcase
from pathlib import Path

from filelock import FileLock, Timeout

from v3d_torch.errors import InputError, LockedError, OutputError
from v3d_torch.io.names import folder_name
from v3d_torch.runs.file_names import FIGURES, MAP_MASKS, MASKS, RunFile
from v3d_torch.runs.request import read_request

_LOCK = ".run.lock"
"""Name of the lock file, which exists while a run or a batch writes."""

_NO_LOCKS = (ENOLCK, ENOSYS, EOPNOTSUPP)
"""Error numbers of file systems without locks."""

_FILES = tuple(file.value for file in RunFile if file is not RunFile.LOG)
"""Names of the files that a run, or the report of a run, writes in addition to the log."""

_IMAGES = (f"{MASKS}/*.png", f"{MAP_MASKS}/*.png")
"""Patterns of the images that a run with ``--save-masks`` writes."""

_SUBFOLDERS = (FIGURES, MASKS, MAP_MASKS)
"""Folders of images."""

_UNFINISHED = (".*.part*", *(f"{subfolder}/.*.part*" for subfolder in _SUBFOLDERS))
"""Patterns of the temporary files of a run that was killed while it wrote."""


def make_result_folder(out: Path | None, name: str) -> Path:
    """Make the folder of the results of a run.

    Args:
        out: Folder given by the user; None to make ``results/<name>/<time>``, and a link ``latest`` to it.
        name: Name of the sequence.

    Raises:
        OutputError: If the folder cannot be made.
    """
    runs = Path("results") / folder_name(name)
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            return out
        folder = _make_folder_by_time(runs)
    except OSError as error:
        raise _unmakeable_error(out or runs, error) from error
    link = runs / f".latest.{os.getpid()}"  # renamed afterwards, so that ``latest`` always exists
    with suppress(OSError):  # Windows without developer mode and some file systems have no links
        link.symlink_to(folder.name)
        link.replace(runs / "latest")
    return folder


def remove_empty_folder(folder: Path) -> None:
    """Remove the folder of `make_result_folder` and the link to it, if a run has written nothing to the folder."""
    link = folder.with_name("latest")
    with suppress(OSError):
        folder.rmdir()
        if link.is_symlink() and not link.exists():
            link.unlink()


def _unmakeable_error(folder: Path, error: OSError) -> OutputError:
    return OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder with --out")


def _make_folder_by_time(runs: Path) -> Path:
    """Make a folder named by the time; runs that start in the same second get a number."""
    runs.mkdir(parents=True, exist_ok=True)
    now = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    folder, number = runs / now, 1
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
            folder = runs / f"{now}_{number}"
        else:
            return folder


def check_unlocked(folder: Path) -> None:
    """Check that no run or batch is writing to a folder, which can be missing.

    Raises:
        LockedError: If another run or batch is writing to the folder.
        OutputError: If it cannot be made or written.
    """
    try:
        is_folder = folder.is_dir()
    except OSError as error:  # such as a name that is too long
        raise _unmakeable_error(folder, error) from error
    if is_folder:
        with lock_results(folder):
            pass


@contextmanager
def lock_results(folder: Path) -> Iterator[None]:
    """Keep other runs and batches from writing to a folder, which is made if it is missing, until the end of the block.

    The lock of a process that is killed ends with it. On a file system without locks, nothing is locked.

    Raises:
        LockedError: If another run or batch is writing to the folder.
        OutputError: If it cannot be written.
    """
    lock = FileLock(folder / _LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout as error:
        raise LockedError(
            f"{folder}: another run or batch is writing to this folder; wait until it ends, or choose another folder"
            " with --out"
        ) from error
    except NotImplementedError:  # older versions of filelock raise it for ENOSYS
        pass
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise _unwritable_error(folder, error) from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes the file of a lock only when it is released
            (folder / _LOCK).unlink()
        lock.release()


def find_earlier_results(folder: Path) -> list[Path]:
    """Return the files of an earlier run in a folder, without its log.

    Raises:
        OutputError: If the folder has files with the names of results but no log of a run: they can be the user's own,
            such as a ground truth.
    """
    patterns = (*_FILES, *(_IMAGES if _has_saved_masks(folder) else ()), *_UNFINISHED)
    earlier = [path for pattern in patterns for path in sorted(folder.glob(pattern))]
    if earlier and not (folder / RunFile.LOG).is_file():
        raise OutputError(f"{earlier[0]}: exists and was not written by a run; choose another folder with --out")
    return earlier


def _has_saved_masks(folder: Path) -> bool:
    """Check whether the earlier run in a folder saved masks: otherwise images there are those of the user."""
    try:
        return read_request(folder).save_masks
    except InputError:  # missing, or of another version
        return (folder / RunFile.LOG).is_file()


def is_result(path: Path, folder: Path) -> bool:
    """Check whether a run writes a path in the folder of its results, or removes it as one of an earlier run."""
    path, folder = Path(os.path.realpath(path)), Path(os.path.realpath(folder))  # also of a loop of links
    if not path.is_relative_to(folder):
        return False
    name = path.relative_to(folder).as_posix()
    return any(
        fnmatchcase(name, pattern) for pattern in (*_FILES, *_IMAGES, *_UNFINISHED, *_SUBFOLDERS, _LOCK, RunFile.LOG)
    )


def clear_earlier_results(folder: Path) -> None:
    """Remove the results of an earlier run from a folder; other files stay.

    Raises:
        OutputError: As `find_earlier_results` raises it, or if the folder cannot be written.
    """
    try:
        for path in find_earlier_results(folder):
            path.unlink()
        for subfolder in _SUBFOLDERS:
            with suppress(OSError):  # missing, or with other files in it
                (folder / subfolder).rmdir()
    except OSError as error:
        raise _unwritable_error(folder, error) from error


def _unwritable_error(folder: Path, error: OSError) -> OutputError:
    return OutputError(f"{folder}: cannot be written ({error.strerror}); choose another folder with --out")


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files of a run that was killed while it wrote."""
    for pattern in _UNFINISHED:
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)
