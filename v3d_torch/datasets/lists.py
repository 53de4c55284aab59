"""The text files of the TUM layout: lists of stamped images, and pairs of them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TypeVar

from v3d_torch.datasets.images import is_depth
from v3d_torch.errors import InputError
from v3d_torch.io.text import numbered_lines
from v3d_torch.io.timestamps import associate, parse_timestamp

_T = TypeVar("_T")

_EXPECTED = "a list has lines of a stamp and a file"

_MAX_GAP = 10.0
"""No camera that can be followed takes an image so rarely, seconds; one at 30 Hz does, by stamps in milliseconds."""

MAX_DIFFERENCE = 0.02
"""Colour and depth farther apart than this are no pair, seconds (the benchmark's own choice)."""


@dataclass(frozen=True)
class ImagePair:
    """A colour and a depth image that belong together; files relative to the sequence's folder."""

    stamp: float
    colour: str
    depth: str
    depth_delay: float = field(default=0.0, kw_only=True)  # of the depth image, seconds after the colour image


def read_image_list(path: Path) -> list[tuple[float, str]]:
    """Read lines of ``stamp file``, in order of time.

    The file's name is all that follows the stamp, spaces included. Comments, blank lines, a byte order mark and either
    line ending are allowed; of equal stamps the first counts.

    Returns:
        (seconds, file), stamps strictly increasing.

    Raises:
        InputError: the list cannot be read, is empty, or a line is not a stamp and a file.
    """
    entries = []
    for number, line in numbered_lines(path, _EXPECTED):
        match = re.fullmatch(r"([^\s,]+)[\s,]+(.+)", line)
        if match is None:
            raise InputError(
                f"{path}: line {number} is {line[:80]!r} where a stamp and a file are expected; repair or remove it"
            )
        entries.append((_stamp(match[1], path, number), match[2]))
    return _in_order(entries, path)


def read_associations(path: Path) -> list[ImagePair]:
    """Read lines of ``stamp file stamp file``, in order of the colour stamps.

    Colour may come first or depth: both are in use, and a look at the images of the first line tells.

    Raises:
        InputError: as `read_image_list`.
    """
    rows = []
    for number, line in numbered_lines(path, _EXPECTED):
        words = list(re.finditer(r"[^\s,]+", line))
        # The first name ends with a suffix and a number follows: names may hold spaces.
        middle = next((i for i in range(2, len(words) - 1) if _parts_names(words[i - 1][0], words[i][0])), None)
        if middle is None:
            raise InputError(
                f"{path}: line {number} is {line[:80]!r} where stamp, file, stamp, file are expected; write it so, or"
                " leave only rgb.txt and depth.txt there"
            )
        first, second = words[0][0], words[middle][0]
        names = (line[words[1].start() : words[middle - 1].end()], line[words[middle + 1].start() :])
        rows.append((_stamp(first, path, number), names[0], _stamp(second, path, number), names[1]))
    if rows and is_depth(path.parent / rows[0][1]) and not is_depth(path.parent / rows[0][3]):
        rows = [(stamp, colour, other, depth) for other, depth, stamp, colour in rows]
    ordered = _in_order(((stamp, (colour, depth, other)) for stamp, colour, other, depth in rows), path)
    return [
        ImagePair(stamp, colour, depth, depth_delay=_delay(stamp, other)) for stamp, (colour, depth, other) in ordered
    ]


def pair_lists(colour: Path, depth: Path) -> list[ImagePair]:
    """Join the images of two lists in a folder one to one by nearest stamps, at most `MAX_DIFFERENCE` apart.

    Returns:
        Pairs with the colour image's stamp.

    Raises:
        InputError: as `read_image_list`, a list is missing, or there is no pair.
    """
    for path in (colour, depth):
        if not path.is_file():
            raise InputError(
                f"{path.parent}: has no {path.name}; the sequence's images are listed in {colour.name} and {depth.name}"
            )
    images, depths = read_image_list(colour), read_image_list(depth)
    indices = associate([stamp for stamp, _ in images], [stamp for stamp, _ in depths], MAX_DIFFERENCE)
    if not indices:
        raise InputError(
            f"{colour.parent}: no stamp in {colour.name} lies within {MAX_DIFFERENCE} s of one in {depth.name};"
            " do both lists belong to this sequence?"
        )
    return [ImagePair(*images[i], depths[j][1], depth_delay=_delay(images[i][0], depths[j][0])) for i, j in indices]


def refuse_other_units(pairs: Sequence[ImagePair], folder: Path) -> None:
    """Raise InputError where frames lie so far apart that their stamps cannot be seconds."""
    gap = median(later.stamp - earlier.stamp for earlier, later in pairwise(pairs)) if len(pairs) > 1 else 0.0
    if gap > _MAX_GAP:
        raise InputError(
            f"{folder}: by their stamps its images lie {gap:g} s apart; stamps are seconds, divide them in the lists if"
            " they are milli- or nanoseconds"
        )


def _parts_names(before: str, word: str) -> bool:
    """Whether a word is the stamp between two names of files, by it and by the word before."""
    return re.fullmatch(r"[-+\d.e]+", word) is not None and re.search(r"\.\w+$", before) is not None


def _stamp(word: str, path: Path, number: int) -> float:
    try:
        stamp = parse_timestamp(word)
    except ValueError:
        stamp = math.nan
    if not math.isfinite(stamp):
        raise InputError(
            f"{path}: line {number} has {word[:80]!r} where a stamp in seconds is expected; repair or remove the line"
        )
    return stamp


def _delay(colour: float, depth: float) -> float:
    """Seconds from one stamp to the other; 0 where they are of different clocks, as no pair lies so far apart."""
    return depth - colour if abs(depth - colour) <= MAX_DIFFERENCE else 0.0


def _in_order(entries: Iterable[tuple[float, _T]], path: Path) -> list[tuple[float, _T]]:
    """Sorted by stamp, the first of equal ones kept."""
    first: dict[float, _T] = {}
    for stamp, value in entries:
        first.setdefault(stamp, value)
    if not first:
        raise InputError(f"{path}: lists no images; {_EXPECTED}, copy it again")
    return sorted(first.items(), key=lambda entry: entry[0])
