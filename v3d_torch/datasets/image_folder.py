"""A folder of colour and depth images without lists: order, pairs and times come from the files' names."""

from __future__ import annotations

import re
from pathlib import Path

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.file_names import images_in, stamp
from v3d_torch.datasets.lists import MAX_DIFFERENCE, ImagePair
from v3d_torch.datasets.paired import PairedImages
from v3d_torch.errors import InputError
from v3d_torch.io.timestamps import associate

_COLOUR = re.compile(r"rgb|colou?r|image|img|photo", re.IGNORECASE)
_DEPTH = re.compile(r"depth", re.IGNORECASE)


class ImageFolder(PairedImages):
    """Frames of a folder with two folders of images (``rgb`` and ``depth``), or with both kinds side by side.

    Images belong together whose names are near times, else whose names differ in the kind only (``7_rgb.jpg`` and
    ``7_depth.png``), else those at equal places in the order of names.

    Args:
        folder: the sequence's folder.
        camera: the user's choice; None takes the ``camera.yaml`` or ``K.txt`` of the folder.
        fps: frames a second; None takes the times from the names.

    Raises:
        InputError: there are no pairs, no times or no camera.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None, *, fps: float | None = None) -> None:
        colour, depth = _kinds(folder)
        files = _matched(folder, colour, depth)
        stamps = _stamps(folder, [path for path, _ in files], fps)
        pairs = [
            ImagePair(seconds, *(str(path.relative_to(folder)) for path in both))
            for seconds, both in sorted(dict(zip(stamps, files, strict=True)).items())
        ]
        super().__init__(folder, pairs, choose_camera(camera, folder))


def is_image_folder(path: Path) -> bool:
    """Whether a folder holds images of both kinds."""
    return path.is_dir() and all(_kinds(path))


def _kinds(folder: Path) -> tuple[list[Path], list[Path]]:
    """Colour and depth images, from a folder for each or from their own names."""
    folders = [entry for entry in sorted(folder.iterdir()) if entry.is_dir() and images_in(entry)]
    depth = [entry for entry in folders if _DEPTH.search(entry.name)]
    colour = [entry for entry in folders if entry not in depth and _COLOUR.search(entry.name)]
    if len(colour) > 1 or len(depth) > 1:
        names = ", ".join(entry.name for entry in colour + depth)
        raise InputError(f"{folder}: holds {names}; leave one folder of colour and one of depth images there")
    if colour and depth:
        return images_in(colour[0]), images_in(depth[0])
    images = images_in(folder)
    depths = [path for path in images if _DEPTH.search(path.stem)]
    return [path for path in images if path not in depths and _COLOUR.search(path.stem)], depths


def _matched(folder: Path, colour: list[Path], depth: list[Path]) -> list[tuple[Path, Path]]:
    times, depth_times = _by_time(colour), _by_time(depth)
    if len(times) == len(colour) and len(depth_times) == len(depth):
        indices = associate(list(times), list(depth_times), MAX_DIFFERENCE)
        if not indices:
            raise InputError(
                f"{folder}: no colour image is within {MAX_DIFFERENCE} s of a depth image; do they belong together?"
            )
        return [(list(times.values())[i], list(depth_times.values())[j]) for i, j in indices]
    partners = {_without_kind(path): path for path in depth}
    if named := [(path, partners[_without_kind(path)]) for path in colour if _without_kind(path) in partners]:
        return named
    if len(colour) != len(depth):
        raise InputError(
            f"{folder}: has {len(colour)} colour and {len(depth)} depth images whose names have nothing in common;"
            " name those that belong together alike"
        )
    return list(zip(colour, depth, strict=True))


def _without_kind(path: Path) -> str:
    return _DEPTH.sub("", _COLOUR.sub("", path.stem)).strip("-_. ")


def _by_time(paths: list[Path]) -> dict[float, Path]:
    """Those whose names are times, in order of time."""
    return dict(sorted((seconds, path) for path in paths if (seconds := stamp(path)) is not None))


def _stamps(folder: Path, colour: list[Path], fps: float | None) -> list[float]:
    if fps is not None:
        return [index / fps for index in range(len(colour))]
    stamps = [seconds for path in colour if (seconds := stamp(path)) is not None]
    if len(stamps) != len(colour):
        raise InputError(f"{folder}: names such as {colour[0].name} are no times; give the frames a second with --fps")
    return stamps
