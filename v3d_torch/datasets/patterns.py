"""Several sequences by one pattern: paths, what is in the user's folder of sequences, names of the benchmark."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from pathlib import Path

from v3d_torch.datasets.locate import data_folder
from v3d_torch.datasets.names import SEQUENCES, short_name
from v3d_torch.datasets.sources import is_source
from v3d_torch.errors import InputError

_WILDCARDS = "*?["


def matching_sequences(pattern: str, data_root: Path | None = None) -> list[str]:
    """The sequences that a pattern speaks of, each as `load_sequence` takes it.

    Wildcards are those of the shell, ``*``, ``?`` and ``[ ]``. They match paths, and the names of what is in
    ``data_root`` (see `data_folder`), as far as these hold a sequence; and names of the TUM RGB-D benchmark, short or
    long (``fr3/w/*``, ``freiburg3_walking_*``), whether the sequence is here or has to be downloaded. A pattern that
    begins with a wildcard speaks of what is here only: ``*`` is not the whole benchmark. The benchmark's validation
    sequences, which have no ground truth, are meant only where the pattern says ``validation``.

    Args:
        pattern: a name or a path without wildcards is returned as it is.
        data_root: where sequences are kept.

    Returns:
        Each sequence once: paths, then what is in ``data_root``, each in alphabetical order, then names.

    Raises:
        InputError: nothing matches.
    """
    path = Path(pattern).expanduser()
    if not any(wildcard in pattern for wildcard in _WILDCARDS) or path.exists():
        return [pattern]
    root = data_folder(data_root)
    here = [str(found) for found in _stored(Path(path.anchor), path)]
    there = [] if path.is_absolute() else [str(found.relative_to(root)) for found in _stored(root, path)]
    names = [] if pattern[0] in _WILDCARDS else _names(pattern)
    if found := list(dict.fromkeys([*here, *there, *names])):
        return found
    raise InputError(
        f"{pattern}: matches no sequence, neither as a path, nor in {root}, nor among the names of the TUM benchmark"
        " (fr3/w/xyz, fr1/desk ...)"
    )


def _stored(root: Path, pattern: Path) -> list[Path]:
    """What holds a sequence among the paths that match a pattern below ``root``, or one from there on."""
    return [found for found in sorted(root.glob(str(pattern.relative_to(pattern.anchor)))) if is_source(found)]


def _names(pattern: str) -> list[str]:
    """Short names of the benchmark's sequences that a pattern matches in one of their spellings."""
    wanted = _plain(pattern)
    found = []
    for full in SEQUENCES:
        long = full.removeprefix("rgbd_dataset_")
        spellings = (full, long, long.replace("freiburg", "fr"), _plain(short_name(full)))
        if full.endswith("_validation") > ("validation" in wanted):
            continue
        if any(fnmatchcase(spelling, wanted) for spelling in spellings):
            found.append(short_name(full))
    return found


def _plain(name: str) -> str:
    return re.sub(r"[/_]+", "_", name.lower())
