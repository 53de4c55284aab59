"""Image lists of the TUM layout: timestamped files, and association of colour and depth images."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TypeVar

from v3d_torch.datasets.depth_files import is_depth_file
from v3d_torch.errors import InputError
from v3d_torch.io.text_file import numbered_lines, replace_odd_spaces
from v3d_torch.io.timestamps import associate, parse_timestamp

_T = TypeVar("_T")

_EXPECTED = "a list has a timestamp and a file name on each line"

_MAX_GAP = 10.0
"""Maximum median time between images, seconds. Images farther apart cannot be tracked; timestamps in milliseconds at
30 Hz exceed this limit."""

_MIN_GAP = 0.001
"""Minimum median time between images, seconds: no RGB-D camera has 1000 Hz, so smaller gaps are not in seconds."""

MAX_STAMP_DIFFERENCE = 0.02
"""Maximum difference between the timestamps of a colour and a depth image of one frame, seconds: the default of the
TUM benchmark's association tool."""

MIN_PAIRED = 0.9
"""Minimum fraction of images that are paired, of the kind with fewer images: cameras drop single images, but if more
have no partner, colour and depth do not belong together."""

_LIMIT = f"{1000 * MAX_STAMP_DIFFERENCE:g} ms"


@dataclass(frozen=True)
class ImagePair:
    """Colour and depth image file of one frame.

    Attributes:
        stamp: Timestamp of the colour image, seconds.
        colour: Path of the colour image, relative to the sequence's folder.
        depth: Path of the depth image, relative to the sequence's folder.
        depth_delay: Depth stamp minus colour stamp, seconds.
    """

    stamp: float
    colour: str
    depth: str
    depth_delay: float = field(default=0.0, kw_only=True)


def read_image_list(path: Path) -> list[tuple[float, str]]:
    """Read a list with lines of ``stamp file``.

    The file name is everything after the stamp and can contain spaces. Comments, blank lines, a byte order mark and
    all line endings are accepted. If a timestamp occurs more than once, the first line is used.

    Args:
        path: Path of the list.

    Returns:
        Pairs of timestamp (seconds) and file name, timestamps strictly increasing.

    Raises:
        InputError: If the list cannot be read, is empty, or contains an invalid line.
    """
    entries = []
    for number, line in numbered_lines(path, _EXPECTED):
        match = re.fullmatch(r"([^\s,]+)[\s,]+(.+)", line)
        if match is None:
            raise InputError(
                f"{path}: line {number} is {line[:80]!r}, expected a timestamp and a file name; correct or remove it"
            )
        entries.append((_parse_stamp(match[1], path, number), _find_file(path.parent, match[2])))
    return _sort_unique(entries, path)


def read_associations(path: Path) -> tuple[list[ImagePair], str | None]:
    """Read a list with lines of ``stamp file stamp file``.

    Both orders are in use, colour first and depth first. The image headers of the first line with a colour and a depth
    image decide between them. Numbers after the second file are ignored: a pose that the TUM benchmark's association
    tool appended.

    Args:
        path: Path of the list, in the sequence's folder.

    Returns:
        Pairs in the order of the colour timestamps; and a sentence on pairs whose timestamps differ by more than 20 ms,
        None if there are none.

    Raises:
        InputError: If the list cannot be read, is empty, or contains an invalid line.
    """
    rows = []
    for number, line in numbered_lines(path, _EXPECTED):
        words = list(re.finditer(r"[^\s,]+", line))
        # File names can contain spaces: the stamp after one is a number that follows a file suffix.
        after_files = [i for i in range(2, len(words)) if _is_stamp_after_file(words[i - 1][0], words[i][0])]
        middle, end, *_ = [*after_files, len(words), len(words)]
        if middle + 1 >= end:
            raise InputError(
                f"{path}: line {number} is {line[:80]!r}, expected timestamp, file, timestamp, file; correct it, or"
                " remove this list and use rgb.txt and depth.txt"
            )
        first, second = words[0][0], words[middle][0]
        files = words[1:middle], words[middle + 1 : end]
        listed = [line[each[0].start() : each[-1].end()] for each in files]
        names = [_find_file(path.parent, name) for name in listed]
        rows.append((_parse_stamp(first, path, number), names[0], _parse_stamp(second, path, number), names[1]))
    if _is_depth_first(path.parent, rows):
        rows = [(stamp, colour, depth_stamp, depth) for depth_stamp, depth, stamp, colour in rows]
    ordered = _sort_unique(
        ((stamp, (colour, depth, depth_stamp)) for stamp, colour, depth_stamp, depth in rows),
        path,
    )
    pairs = [
        ImagePair(stamp, colour, depth, depth_delay=depth_delay(stamp, depth_stamp))
        for stamp, (colour, depth, depth_stamp) in ordered
    ]
    return pairs, _note_far_pairs(path, [depth_stamp - stamp for stamp, (_, _, depth_stamp) in ordered])


def _note_far_pairs(path: Path, differences: Sequence[float]) -> str | None:
    """Return a sentence on pairs whose timestamps (depth minus colour, seconds) differ much; None if there are none."""
    far = [difference for difference in differences if abs(difference) > MAX_STAMP_DIFFERENCE]
    if not far:
        return None
    return (
        f"{path}: the timestamps of {len(far)} of {len(differences)} pairs are more than {_LIMIT} apart (median of"
        f" depth minus colour {median(far):.3f} s); colour and depth of these pairs count as simultaneous"
    )


def pair_lists(colour: Path, depth: Path) -> tuple[list[ImagePair], str | None]:
    """Associate the images of two lists one to one by nearest timestamps, at most 20 ms apart.

    Args:
        colour: Path of the list of colour images, in the sequence's folder.
        depth: Path of the list of depth images, in the same folder.

    Returns:
        Pairs in the order of the colour timestamps; and a sentence on colour images without depth, see `check_paired`.

    Raises:
        InputError: If a list is missing or invalid (see `read_image_list`), or too few timestamps match.
    """
    for path in (colour, depth):
        if not path.is_file():
            raise InputError(
                f"{path.parent}: has no {path.name}; list the images of the sequence in {colour.name} and {depth.name}"
            )
    images, depths = read_image_list(colour), read_image_list(depth)
    stamps, depth_stamps = [stamp for stamp, _ in images], [stamp for stamp, _ in depths]
    indices = associate(stamps, depth_stamps, MAX_STAMP_DIFFERENCE)
    if not indices:
        raise InputError(
            f"{colour.parent}: no timestamp in {colour.name} is within {MAX_STAMP_DIFFERENCE} s of one in {depth.name};"
            " check that both lists belong to the same recording"
        )
    pairs = [
        ImagePair(*images[i], depths[j][1], depth_delay=depth_delay(stamps[i], depth_stamps[j])) for i, j in indices
    ]
    return pairs, check_paired(colour.parent, stamps, depth_stamps, indices)


def check_paired(
    source: object, colour: Sequence[float], depth: Sequence[float], pairs: Sequence[tuple[int, int]]
) -> str | None:
    """Check that colour and depth images that were paired by their timestamps belong together.

    Images from before or after all images of the other kind do not count: a stream can start late or stop early. Nor do
    colour images if depth has a lower rate.

    Args:
        source: Path of the sequence, for messages.
        colour: Timestamps of the colour images, seconds, increasing.
        depth: Timestamps of the depth images, seconds, increasing.
        pairs: Result of `associate`, not empty.

    Returns:
        A sentence on colour images without depth, see `note_unpaired`.

    Raises:
        InputError: If less than `MIN_PAIRED` of the images are paired.
    """
    start = max(colour[0], depth[0]) - MAX_STAMP_DIFFERENCE
    end = min(colour[-1], depth[-1]) + MAX_STAMP_DIFFERENCE
    common = min(sum(start <= stamp <= end for stamp in stamps) for stamps in (colour, depth))
    if len(pairs) < MIN_PAIRED * common:
        raise InputError(
            f"{source}: only {len(pairs)} of {len(colour)} colour and {len(depth)} depth images are within {_LIMIT} of"
            " each other; check that both belong to the same recording, or list the pairs in associations.txt"
        )
    return note_unpaired(colour, pairs)


def note_unpaired(colour: Sequence[float], pairs: Sequence[tuple[int, int]]) -> str | None:
    """Return a sentence on the colour images that have no depth image within 20 ms; None if all have one.

    Args:
        colour: Timestamps of the colour images, seconds, increasing.
        pairs: Result of `associate`.
    """
    paired = {index for index, _ in pairs}
    unpaired = [stamp for index, stamp in enumerate(colour) if index not in paired]
    if not unpaired:
        return None
    return (
        f"{len(unpaired)} of {len(colour)} colour images have no depth image within {_LIMIT} and are left out (the last"
        f" at {unpaired[-1]:.6f} s)"
    )


def depth_delay(colour: float, depth: float) -> float:
    """Return depth stamp minus colour stamp; 0 if they differ so much that they come from different clocks."""
    return depth - colour if abs(depth - colour) <= MAX_STAMP_DIFFERENCE else 0.0


def check_stamp_unit(pairs: Sequence[ImagePair], folder: Path, other_fix: str = "") -> None:
    """Check that the time between images is plausible for timestamps in seconds.

    Args:
        pairs: Images in the order of time.
        folder: Folder of the images, for messages.
        other_fix: End of the messages: what the user can do besides converting the timestamps.

    Raises:
        InputError: If the images are so far apart, or so close to each other, that the timestamps must be in another
            unit.
    """
    if len(pairs) < 2:
        return
    gap = median(later.stamp - earlier.stamp for earlier, later in pairwise(pairs))
    if gap < _MIN_GAP:
        raise InputError(
            f"{folder}: the images are {gap:g} s apart according to their timestamps; convert the timestamps to"
            f" seconds{other_fix}"
        )
    if gap > _MAX_GAP:
        raise InputError(
            f"{folder}: the images are {gap:g} s apart according to their timestamps; convert the timestamps to"
            f" seconds (they are probably in milliseconds or nanoseconds){other_fix}"
        )


def _is_depth_first(folder: Path, rows: Iterable[tuple[float, str, float, str]]) -> bool:
    """Check whether the first file of each row is the depth image; rows with missing or damaged files are ignored."""
    pairs = ((is_depth_file(folder / first), is_depth_file(folder / second)) for _, first, _, second in rows)
    return next((first for first, second in pairs if first != second), False)


def _is_stamp_after_file(previous: str, word: str) -> bool:
    """Check whether a word is a timestamp after a file name."""
    is_number = re.fullmatch(r"[-+\d.e]+", replace_odd_spaces(word)) is not None
    return is_number and re.search(r"\.\w+$", replace_odd_spaces(previous)) is not None


def _find_file(folder: Path, name: str) -> str:
    """Return the name under which a listed file exists: with slashes for backslashes, or with plain spaces.

    Args:
        folder: Folder of the list.
        name: Name in the list; it stays unchanged if the file exists, or if no variant of the name exists.
    """
    variants = dict.fromkeys((name, name.replace("\\", "/"), replace_odd_spaces(name).strip()))
    variants[replace_odd_spaces(name).strip().replace("\\", "/")] = None
    if len(variants) == 1:
        return name
    with suppress(OSError, ValueError):  # such as a name that is too long; reported when the images are looked up
        return next((variant for variant in variants if (folder / variant).is_file()), name)
    return name


def _parse_stamp(word: str, path: Path, number: int) -> float:
    try:
        stamp = parse_timestamp(replace_odd_spaces(word))
    except ValueError:
        stamp = math.nan
    if not math.isfinite(stamp):
        raise InputError(
            f"{path}: line {number} has {word[:80]!r}, expected a timestamp in seconds; correct or remove the line"
        )
    return stamp


def _sort_unique(entries: Iterable[tuple[float, _T]], path: Path) -> list[tuple[float, _T]]:
    """Sort entries by timestamp and keep the first entry of each timestamp."""
    first: dict[float, _T] = {}
    for stamp, value in entries:
        first.setdefault(stamp, value)
    if not first:
        raise InputError(f"{path}: lists no images; {_EXPECTED}, copy it again")
    return sorted(first.items(), key=lambda entry: entry[0])
