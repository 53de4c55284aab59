"""Selection of several sequences by patterns: paths, the user's data, and names of the TUM benchmark."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from v3d_torch.datasets.locate import data_folder, identify
from v3d_torch.datasets.sequence_names import PAPER_SEQUENCES, SEQUENCES, short_name
from v3d_torch.datasets.sources import is_source
from v3d_torch.errors import InputError

_WILDCARDS = "*?["

_NAMED_FOLDERS = 3
"""Number of folders that a note names; a pattern can match hundreds of others."""


@dataclass(frozen=True)
class MatchedSequences:
    """Sequences and other folders that names, paths and patterns match.

    Attributes:
        sequences: Sequences, in the form that `load_sequence` accepts.
        other_folders: Folders that are not a sequence, by the pattern that matches them, without hidden folders.
    """

    sequences: Sequence[str]
    other_folders: Mapping[str, Sequence[str]]

    @property
    def notes(self) -> list[str]:
        """Sentences about the folders that are not a sequence: one of them may have been meant."""
        notes = []
        for pattern, folders in self.other_folders.items():
            left_out = (
                "1 folder is no sequence and is left out"
                if len(folders) == 1
                else f"{len(folders)} folders are no sequences and are left out"
            )
            named = ", ".join(folders[:_NAMED_FOLDERS]) + (" ..." if len(folders) > _NAMED_FOLDERS else "")
            notes.append(f"{pattern}: {left_out}: {named}")
        return notes


def matching_sequences(patterns: Iterable[str], data_root: Path | None = None) -> MatchedSequences:
    """Find the sequences that match names, paths and patterns.

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
        Sequences in the order of the patterns, each once, in its first spelling, and the other folders that match. The
        matches of a pattern are ordered as above: paths and entries of ``data_root`` alphabetically, benchmark names
        with those of the paper first.

    Raises:
        InputError: If a pattern has no matches.
    """
    root = data_folder(data_root)
    sequences: dict[Path | str, str] = {}
    other_folders: dict[str, list[str]] = {}
    for pattern in patterns:
        try:
            names, folders = _match(pattern, root)
            for name in names:
                sequences.setdefault(identify(name, data_root), name)
        except (OSError, RuntimeError, ValueError) as error:  # name too long, unknown user after ~, ** within a name
            raise InputError(f"{pattern}: is not a valid pattern ({error}); check the path") from error
        if folders:
            other_folders[pattern] = folders
    return MatchedSequences(list(sequences.values()), other_folders)


def _match(pattern: str, root: Path) -> tuple[list[str], list[str]]:
    """Return the sequences and the other folders that match a pattern."""
    path = Path(pattern).expanduser()
    if not any(wildcard in pattern for wildcard in _WILDCARDS) or path.exists():
        return [pattern], []
    if any("**" in part and part != "**" for part in path.parts):  # from Python 3.13 on, ** then means *
        raise ValueError("** stands for whole folders only")
    paths, folders = _match_paths(Path(path.anchor), path)
    names = [*map(str, paths)]
    other_folders = [*map(str, folders)]
    if not path.is_absolute():
        paths, folders = _match_paths(root, path)
        names += [str(found.relative_to(root)) for found in paths]
        other_folders += [str(found.relative_to(root)) for found in folders]
    names += [] if pattern[0] in _WILDCARDS else _match_names(pattern)
    if names:
        return names, list(dict.fromkeys(other_folders))  # the root can be the current folder
    raise InputError(
        f"{pattern}: matches no sequence; searched for paths, in {root}, and for names of the TUM benchmark"
        " (fr3/w/xyz, fr1/desk ...)"
    )


def _match_paths(root: Path, pattern: Path) -> tuple[list[Path], list[Path]]:
    """Find the sequences and the other folders below ``root`` whose relative paths match a pattern.

    Other folders are returned only if there are sequences: else the pattern is meant for another root.
    """
    found = sorted(root.glob(str(pattern.relative_to(pattern.anchor))))
    sequences = [path for path in found if is_source(path)]
    if not sequences:
        return [], []
    others = set(found).difference(sequences)
    return sequences, sorted(path for path in others if path.is_dir() and not path.name.startswith("."))


def _match_names(pattern: str) -> list[str]:
    """Short names of the benchmark's sequences that have a matching spelling."""
    normalised = _normalise(pattern)
    found = []
    for full in dict.fromkeys([*PAPER_SEQUENCES, *SEQUENCES]):
        long = full.removeprefix("rgbd_dataset_")
        spellings = (full, long, long.replace("freiburg", "fr"), _normalise(short_name(full)))
        if full.endswith("_validation") and "validation" not in normalised:
            continue
        if any(fnmatchcase(spelling, normalised) for spelling in spellings):
            found.append(short_name(full))
    return found


def _normalise(name: str) -> str:
    return re.sub(r"[/_]+", "_", name.lower())
