"""Image files of a folder: order, frame numbers and timestamps from their names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from v3d_torch.datasets.depth_files import DEPTH_SUFFIXES
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.errors import InputError
from v3d_torch.io.timestamps import parse_timestamp

SUFFIXES = DEPTH_SUFFIXES | {".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"}
"""Suffixes of image files, in lower case."""

_PARTS = re.compile(r"(\D*)(\d*)")
"""Text and number parts of a name, for sorting."""


def list_images(folder: Path) -> list[Path]:
    """Return the images of a folder sorted by name. Numbers are compared as numbers: 9.png comes before 10.png."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))
    return sorted(files, key=lambda path: [(text, int(digits or 0)) for text, digits in _PARTS.findall(path.stem)])


def frame_number(path: Path) -> int | None:
    """Last number in a file name, such as 120 for ``frame-000120.color.jpg``; None if there is no number."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def stamp_in_name(path: Path) -> float | None:
    """Timestamp in a file name such as ``1305031102.175304.png`` or ``1403636579763555584.png``, seconds; else None."""
    if match := re.search(r"(?<!\d)(\d+\.\d+)$", path.stem):
        return parse_timestamp(match[1])
    if match := re.search(r"(?<!\d)(\d{13}|\d{16}|\d{19})$", path.stem):  # milli-, micro-, nanoseconds since 1970
        return parse_timestamp(match[1])
    return None


def pair_by_number(folder: Path, colour: Iterable[Path], depth: Iterable[Path], rate: float) -> list[ImagePair]:
    """Pair colour and depth images with equal frame numbers.

    Args:
        folder: Folder of the sequence; the files of the pairs are relative to it.
        colour: Colour images with numbers in their names.
        depth: Depth images with numbers in their names.
        rate: Frame rate, Hz: converts frame numbers to timestamps.

    Returns:
        Pairs in the order of their frame numbers.

    Raises:
        InputError: If no frame number has both images.
    """
    by_number = [{frame_number(path): path for path in files} for files in (colour, depth)]
    numbers = sorted(number for number in by_number[0].keys() & by_number[1].keys() if number is not None)
    if not numbers:
        raise InputError(
            f"{folder}: no colour image has the same frame number as a depth image; check that both belong to the same"
            " recording"
        )
    return [
        ImagePair(number / rate, *(str(files[number].relative_to(folder)) for files in by_number)) for number in numbers
    ]
