"""What the names of image files say of their frames: order, number, time."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from v3d_torch.datasets.lists import ImagePair
from v3d_torch.errors import InputError
from v3d_torch.io.timestamps import parse_timestamp

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"})

_PARTS = re.compile(r"(\D*)(\d*)")


def images_in(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names, numbers compared as numbers: 9.png before 10.png."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))
    return sorted(files, key=lambda path: [(text, int(digits or 0)) for text, digits in _PARTS.findall(path.stem)])


def frame_number(path: Path) -> int | None:
    """The last number in a name, 120 for ``frame-000120.color.jpg``; None where there is none."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def stamp(path: Path) -> float | None:
    """Seconds, where the name is a time: ``1305031102.175304.png``, ``1403636579763555584.png``; else None."""
    if match := re.search(r"(?<!\d)(\d+\.\d+)$", path.stem):
        return parse_timestamp(match[1])
    if match := re.search(r"(?<!\d)(\d{13}|\d{16}|\d{19})$", path.stem):  # milli-, micro-, nanoseconds since 1970
        return parse_timestamp(match[1])
    return None


def numbered_pairs(folder: Path, colour: Iterable[Path], depth: Iterable[Path], rate: float) -> list[ImagePair]:
    """Join the images of equal frame numbers.

    Args:
        folder: that the pairs' files are relative to.
        colour: files with numbers in their names.
        depth: likewise.
        rate: numbers a second, for the stamps.

    Raises:
        InputError: no number has both.
    """
    by_number = [{frame_number(path): path for path in files} for files in (colour, depth)]
    numbers = sorted(number for number in by_number[0].keys() & by_number[1].keys() if number is not None)
    if not numbers:
        raise InputError(f"{folder}: no colour image has the number of a depth image; do they belong together?")
    return [
        ImagePair(number / rate, *(str(files[number].relative_to(folder)) for files in by_number)) for number in numbers
    ]
