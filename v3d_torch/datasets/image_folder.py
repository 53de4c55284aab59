"""Folders of colour and depth images without lists: pairs and timestamps come from the file names."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.image_files import list_images, note_unpaired_files, stamp_in_name
from v3d_torch.datasets.lists import (
    MAX_STAMP_DIFFERENCE,
    MIN_PAIRED,
    ImagePair,
    check_paired,
    check_stamp_unit,
    depth_delay,
)
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.errors import InputError
from v3d_torch.io.timestamps import associate

_COLOUR = re.compile(r"rgb|colou?r|image|img|photo", re.IGNORECASE)
_DEPTH = re.compile(r"depth", re.IGNORECASE)
_LEADING_ZEROS = re.compile(r"(?<!\d)0+(?=\d)")


class ImageFolder(PairedImages):
    """Sequence of images in two subfolders (``rgb`` and ``depth``), or of both kinds side by side in one folder.

    Colour and depth images are paired by the first rule that applies:

    1. by nearest timestamps, at most 20 ms apart, if all names are timestamps;
    2. by names that differ only in the kind, such as ``7_rgb.jpg`` and ``7_depth.png``, or also in leading zeros, such
       as ``rgb/7.png`` and ``depth/0007.png``; images without a partner are left out, of the kind with fewer images at
       most a tenth;
    3. by their position in the sorted lists of names, if no names are equal.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the ``camera.yaml`` or ``K.txt`` in the folder.
        fps: Frame rate of the colour images, Hz, including those without a partner; None to read the timestamps from
            the file names.

    Raises:
        InputError: If there are no pairs, too few of the images have equal names, there are no timestamps or no camera,
            two images have the same timestamp, or the timestamps are not in a known unit.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None, *, fps: float | None = None) -> None:
        colour, depth = _find_images(folder)
        files, note = _pair(folder, colour, depth)
        stamps = _stamps(folder, colour, [path for path, _ in files], fps)
        pairs = [
            ImagePair(
                stamp,
                *(str(path.relative_to(folder)) for path in pair),
                depth_delay=_delay(stamp, pair[1]) if fps is None else 0.0,
            )
            for stamp, pair in sorted(zip(stamps, files, strict=True))
        ]
        if fps is None:
            check_stamp_unit(
                pairs, folder, ", or pass the frame rate with --fps if file names only look like timestamps"
            )
        super().__init__(folder, pairs, camera, pairing_note=note)


def is_image_folder(path: Path) -> bool:
    """Check whether a folder contains colour and depth images, perhaps in more subfolders than can be opened."""
    return path.is_dir() and (all(_image_folders(path)) or all(_images_side_by_side(path)))


def _find_images(folder: Path) -> tuple[list[Path], list[Path]]:
    """Find the colour and depth images, by the names of their subfolders or by their own names."""
    colour, depth = _image_folders(folder)
    if not colour or not depth:
        return _images_side_by_side(folder)
    if len(colour) > 1 or len(depth) > 1:
        names = ", ".join(entry.name for entry in colour + depth)
        raise InputError(
            f"{folder}: has too many image folders ({names}); keep one folder of colour and one of depth images"
        )
    return list_images(colour[0]), list_images(depth[0])


def _image_folders(folder: Path) -> tuple[list[Path], list[Path]]:
    """Subfolders with colour and with depth images, by their names."""
    named = [entry for entry in sorted(folder.iterdir()) if _DEPTH.search(entry.name) or _COLOUR.search(entry.name)]
    folders = [entry for entry in named if entry.is_dir() and list_images(entry)]  # others may not be readable
    depth = [entry for entry in folders if _DEPTH.search(entry.name)]
    return [entry for entry in folders if entry not in depth], depth


def _images_side_by_side(folder: Path) -> tuple[list[Path], list[Path]]:
    """Colour and depth images in the folder itself, by their names."""
    images = list_images(folder)
    depth = [path for path in images if _DEPTH.search(path.stem)]
    return [path for path in images if _COLOUR.search(path.stem) and not _DEPTH.search(path.stem)], depth


def _pair(folder: Path, colour: list[Path], depth: list[Path]) -> tuple[list[tuple[Path, Path]], str | None]:
    """Pair colour and depth images by the rules of `ImageFolder`; also return a sentence on colour without depth."""
    colour_by_stamp, depth_by_stamp = _by_stamp(colour), _by_stamp(depth)
    if len(colour_by_stamp) == len(colour) and len(depth_by_stamp) == len(depth):
        stamps, depth_stamps = list(colour_by_stamp), list(depth_by_stamp)
        indices = associate(stamps, depth_stamps, MAX_STAMP_DIFFERENCE)
        if not indices:
            raise InputError(
                f"{folder}: no colour image is within {MAX_STAMP_DIFFERENCE} s of a depth image; check that both belong"
                " to the same recording"
            )
        in_order, depth_in_order = list(colour_by_stamp.values()), list(depth_by_stamp.values())
        note = check_paired(folder, stamps, depth_stamps, indices)
        return [(in_order[i], depth_in_order[j]) for i, j in indices], note
    pairs = max((_pair_by_name(colour, depth, name) for name in (_without_kind, _without_zeros)), key=len)
    if len(pairs) >= MIN_PAIRED * min(len(colour), len(depth)):
        return pairs, note_unpaired_files(colour, {path for path, _ in pairs}, "name")
    if pairs or len(colour) != len(depth):
        raise InputError(
            f"{folder}: has {len(colour)} colour and {len(depth)} depth images, of which {len(pairs)} can be paired by"
            " name; give the two images of a frame the same name"
        )
    return list(zip(colour, depth, strict=True)), None


def _pair_by_name(colour: list[Path], depth: list[Path], name: Callable[[Path], str]) -> list[tuple[Path, Path]]:
    """Pair images with equal names, in the order of the colour images."""
    colour_by_name, depth_by_name = ({name(path): path for path in paths} for paths in (colour, depth))
    return [(path, depth_by_name[key]) for key, path in colour_by_name.items() if key in depth_by_name]


def _without_kind(path: Path) -> str:
    """File name without the words that denote colour or depth."""
    return _DEPTH.sub("", _COLOUR.sub("", path.stem)).strip("-_. ")


def _without_zeros(path: Path) -> str:
    """File name without the words that denote colour or depth, and without leading zeros of numbers."""
    return _LEADING_ZEROS.sub("", _without_kind(path))


def _by_stamp(paths: list[Path]) -> dict[float, Path]:
    """Images whose names are timestamps, in temporal order."""
    return dict(sorted((stamp, path) for path in paths if (stamp := stamp_in_name(path)) is not None))


def _stamps(folder: Path, colour: list[Path], paired: list[Path], fps: float | None) -> list[float]:
    """Timestamps of the paired colour images, seconds, from their positions among all of them or from their names."""
    if fps is not None:
        by_stamp = _by_stamp(colour)
        in_order = by_stamp.values() if len(by_stamp) == len(colour) else colour
        position = {path: index for index, path in enumerate(in_order)}
        return [position[path] / fps for path in paired]
    stamps = [stamp for path in paired if (stamp := stamp_in_name(path)) is not None]
    if len(stamps) != len(paired):
        raise InputError(
            f"{folder}: file names such as {paired[0].name} are not timestamps; pass the frame rate with --fps"
        )
    for (earlier, path), (later, following) in pairwise(sorted(zip(stamps, paired, strict=True))):
        if earlier == later:
            raise InputError(
                f"{folder}: {path.name} and {following.name} have the same timestamp; pass the frame rate with --fps if"
                " file names only look like timestamps, or keep the images of one camera"
            )
    return stamps


def _delay(stamp: float, depth: Path) -> float:
    """Depth delay of a frame, seconds; 0 if the name of its depth image is not a timestamp."""
    depth_stamp = stamp_in_name(depth)
    return 0.0 if depth_stamp is None else depth_delay(stamp, depth_stamp)
