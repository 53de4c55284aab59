"""Selection of several sequences by patterns: paths, the user's data, and names of the TUM benchmark."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from v3d_torch.datasets.locate import data_folder, identify
from v3d_torch.datasets.sequence_names import PAPER_SEQUENCES, SEQUENCES, short_name
from v3d_torch.datasets.sources import is_source
from v3d_torch.errors import InputError

_WILDCARDS = "*?["


def matching_sequences(patterns: Iterable[str], data_root: Path | None = None) -> list[str]:
    """List the sequences that match names, paths and patterns, in the form that `load_sequence` accepts.

    The wildcards are those of the shell, ``*``, ``?`` and ``[ ]``. A pattern is matched against

    1. paths that contain a sequence;
    2. entries of ``data_root`` (see `data_folder`) that contain a sequence;
    3. long and short names of the TUM RGB-D benchmark (``fr3/w/*``, ``freiburg3_walking_*``), including sequences that
       are not downloaded yet. A pattern that begins with a wildcard is not matched against these names: ``*`` does not
       select the whole benchmark. Validation sequences, which have no ground truth, match only if the pattern contains
       ``validation``.

    Args:
        patterns: Names, paths and patterns. Entries without wildcards are returned unchanged.
        data_root: Folder with the user's sequences; None for ``$V3D_DATA``, or else the cache.

    Returns:
        Sequences in the order of the patterns, each once, in its first spelling. The matches of a pattern are ordered
        as above: paths and entries of ``data_root`` alphabetically, benchmark names with those of the paper first.

    Raises:
        InputError: If a pattern has no matches.
    """
    found: dict[Path | str, str] = {}
    for pattern in patterns:
        try:
            for name in _match(pattern, data_folder(data_root)):
                found.setdefault(identify(name, data_root), name)
        except (OSError, RuntimeError, ValueError) as error:  # name too long, unknown user after ~, ** within a name
            raise InputError(f"{pattern}: is not a valid pattern ({error}); check the path") from error
    return list(found.values())


def _match(pattern: str, root: Path) -> list[str]:
    path = Path(pattern).expanduser()
    if not any(wildcard in pattern for wildcard in _WILDCARDS) or path.exists():
        return [pattern]
    paths = [str(found) for found in _match_paths(Path(path.anchor), path)]
    entries = [] if path.is_absolute() else [str(found.relative_to(root)) for found in _match_paths(root, path)]
    names = [] if pattern[0] in _WILDCARDS else _match_names(pattern)
    if found := [*paths, *entries, *names]:
        return found
    raise InputError(
        f"{pattern}: matches no sequence; searched for paths, in {root}, and for names of the TUM benchmark"
        " (fr3/w/xyz, fr1/desk ...)"
    )


def _match_paths(root: Path, pattern: Path) -> list[Path]:
    """Find the sequences below ``root`` whose relative paths match a pattern."""
    return [found for found in sorted(root.glob(str(pattern.relative_to(pattern.anchor)))) if is_source(found)]


def _match_names(pattern: str) -> list[str]:
    """Short names of the benchmark's sequences that have a matching spelling."""
    normalised = _normalise(pattern)
    found = []
    for full in dict.fromkeys([*PAPER_SEQUENCES, *SEQUENCES]):
        long = full.removeprefix("rgbd_dataset_")
        spellings = (full, long, long.replace("freiburg", "fr"), _normalise(short_name(full)))
        if full.endswith("_validation") > ("validation" in normalised):
            continue
        if any(fnmatchcase(spelling, normalised) for spelling in spellings):
            found.append(short_name(full))
    return found


def _normalise(name: str) -> str:
    return re.sub(r"[/_]+", "_", name.lower())
