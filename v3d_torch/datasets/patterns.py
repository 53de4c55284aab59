"""Several sequences by one pattern: paths, what is in the user's folder of sequences, names of the benchmark."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from v3d_torch.datasets.locate import data_folder
from v3d_torch.datasets.names import PAPER_SEQUENCES, SEQUENCES, canonical_name, short_name
from v3d_torch.datasets.sources import is_source
from v3d_torch.errors import InputError

_WILDCARDS = "*?["


def matching_sequences(patterns: Iterable[str], data_root: Path | None = None) -> list[str]:
    """The sequences that names, paths and patterns speak of, each as `load_sequence` takes it.

    Wildcards are those of the shell, ``*``, ``?`` and ``[ ]``. They match paths, and the names of what is in
    ``data_root`` (see `data_folder`), as far as these hold a sequence; and names of the TUM RGB-D benchmark, short or
    long (``fr3/w/*``, ``freiburg3_walking_*``), whether the sequence is here or has to be downloaded. A pattern that
    begins with a wildcard speaks of what is here only: ``*`` is not the whole benchmark. The benchmark's validation
    sequences, which have no ground truth, are meant only where the pattern says ``validation``.

    Args:
        patterns: in any number; what has no wildcards is taken as it is.
        data_root: where sequences are kept.

    Returns:
        Each sequence once, in the order of the patterns. Of a pattern: paths, then what is in ``data_root``, each in
        alphabetical order, then names of the benchmark, those of the paper's sequences first, in its order.

    Raises:
        InputError: a pattern matches nothing.
    """
    found: dict[str, str] = {}
    for pattern in patterns:
        try:
            names = _matching(pattern, data_folder(data_root))
        except (OSError, RuntimeError, ValueError) as error:  # too long a name, ~ of nobody, ** within a name
            raise InputError(f"{pattern}: can match nothing ({error}); check the path") from error
        for name in names:
            found.setdefault(canonical_name(name) or name, name)
    return list(found.values())


def _matching(pattern: str, root: Path) -> list[str]:
    path = Path(pattern).expanduser()
    if not any(wildcard in pattern for wildcard in _WILDCARDS) or path.exists():
        return [pattern]
    here = [str(found) for found in _stored(Path(path.anchor), path)]
    there = [] if path.is_absolute() else [str(found.relative_to(root)) for found in _stored(root, path)]
    names = [] if pattern[0] in _WILDCARDS else _names(pattern)
    if found := [*here, *there, *names]:
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
    for full in dict.fromkeys([*PAPER_SEQUENCES, *SEQUENCES]):
        long = full.removeprefix("rgbd_dataset_")
        spellings = (full, long, long.replace("freiburg", "fr"), _plain(short_name(full)))
        if full.endswith("_validation") > ("validation" in wanted):
            continue
        if any(fnmatchcase(spelling, wanted) for spelling in spellings):
            found.append(short_name(full))
    return found


def _plain(name: str) -> str:
    return re.sub(r"[/_]+", "_", name.lower())
