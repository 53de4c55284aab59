"""Image files of a folder: order, frame numbers and timestamps from their names."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from v3d_torch.datasets.depth_files import DEPTH_SUFFIXES
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.errors import InputError
from v3d_torch.io.timestamps import parse_timestamp

SUFFIXES = DEPTH_SUFFIXES | {".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"}
"""Suffixes of image files, in lower case."""

_PARTS = re.compile(r"(\D*)(\d*)")
"""Text and number parts of a name, for sorting."""

_DATE_TIME = re.compile(r"(?<!\d)(20\d\d)-?(\d\d)-?(\d\d)[ T_-]?(\d\d)[:._-]?(\d\d)[:._-]?(\d\d)(?:\.?(\d+))?$")
"""Date, time and fraction of a second at the end of a name. Counts since 1970 begin with 20 from the year 2033 on."""

_SECONDS = re.compile(r"(?:^|(?<!\d)(?=\d{10}\.)|^\D+(?=0\.|[1-9]))(\d+\.\d+)$")
"""Seconds at the end of a name. After other numbers, only seconds since 1970: the ``59.70`` of ``10-30-59.70`` is part
of a time. After text, no leading zeros: ``shot_010.0008`` is frame 8 of a shot."""

_COUNT_SINCE_1970 = re.compile(r"(?<!\d)(\d{13}|\d{16}|\d{19})$")
"""Milli-, micro- or nanoseconds since 1970 at the end of a name."""


def list_images(folder: Path) -> list[Path]:
    """Return the images of a folder sorted by name. Numbers are compared as numbers: 9.png comes before 10.png."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))
    return sorted(files, key=lambda path: [(text, int(digits or 0)) for text, digits in _PARTS.findall(path.stem)])


def frame_number(path: Path) -> int | None:
    """Last number in a file name, such as 120 for ``frame-000120.color.jpg``; None if there is no number."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def stamp_in_name(path: Path) -> float | None:
    """Timestamp at the end of a file name, seconds; None if there is none.

    Known are seconds with a fraction (``1305031102.175304.png``), milli-, micro- and nanoseconds since 1970
    (``1403636579763555584.png``), and dates with times (``2026-01-01_10-30-59.70.png``), which are taken as UTC.
    """
    if (match := _DATE_TIME.search(path.stem)) and (seconds := _since_1970(match)) is not None:
        return seconds
    match = _SECONDS.search(path.stem) or _COUNT_SINCE_1970.search(path.stem)
    return parse_timestamp(match[1]) if match else None


def pair_by_number(
    folder: Path, colour: Iterable[Path], depth: Iterable[Path], rate: float
) -> tuple[list[ImagePair], str | None]:
    """Pair colour and depth images with equal frame numbers.

    Args:
        folder: Folder of the sequence; the files of the pairs are relative to it.
        colour: Colour images with numbers in their names.
        depth: Depth images with numbers in their names.
        rate: Frame rate, Hz: converts frame numbers to timestamps.

    Returns:
        Pairs in the order of their frame numbers; and a sentence on colour images without depth, None if all have one.

    Raises:
        InputError: If no frame number has both images.
    """
    by_number = [
        {number: path for path in files if (number := frame_number(path)) is not None} for files in (colour, depth)
    ]
    numbers = sorted(by_number[0].keys() & by_number[1].keys())
    if not numbers:
        raise InputError(
            f"{folder}: no colour image has the same frame number as a depth image; check that both belong to the same"
            " recording"
        )
    pairs = [
        ImagePair(number / rate, *(str(files[number].relative_to(folder)) for files in by_number)) for number in numbers
    ]
    in_order = [by_number[0][number] for number in sorted(by_number[0])]
    return pairs, note_unpaired_files(in_order, {by_number[0][number] for number in numbers}, "frame number")


def note_unpaired_files(colour: Sequence[Path], paired: Container[Path], key: str) -> str | None:
    """Return a sentence on the colour images that have no depth image; None if all have one.

    Args:
        colour: Colour images in their order.
        paired: Those that have a depth image.
        key: What the two images of a frame have in common, such as their name.
    """
    unpaired = [path for path in colour if path not in paired]
    if not unpaired:
        return None
    return (
        f"{len(unpaired)} of {len(colour)} colour images have no depth image of the same {key} and are left out (the"
        f" last is {unpaired[-1].name})"
    )


def _since_1970(match: re.Match[str]) -> float | None:
    """Seconds from 1970 to a match of `_DATE_TIME`; None if it is no valid date and time."""
    year, month, day, hour, minute, second = (int(digits) for digits in match.groups()[:6])
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except ValueError:
        return None
    return whole + float(f"0.{match[7] or 0}")
