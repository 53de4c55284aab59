"""Names of the TUM RGB-D sequences: full names, the short names of the paper's tables, and other spellings."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import PurePath

from v3d_torch.errors import InputError

BUILT_IN_SEQUENCES = ("demo", "demo:sitting", "demo:things")
"""Names of the sequences that are rendered by the package; see `v3d_torch.datasets.demo`."""

_PREFIX = "rgbd_dataset_"

_SEQUENCES = {
    "freiburg1": "360 desk desk2 floor plant room rpy teddy xyz",
    "freiburg2": "360_hemisphere 360_kidnap coke desk desk_with_person dishes flowerbouquet"
    " flowerbouquet_brownbackground large_no_loop large_with_loop metallic_sphere metallic_sphere2 pioneer_360"
    " pioneer_slam pioneer_slam2 pioneer_slam3 rpy xyz",
    "freiburg3": "cabinet large_cabinet long_office_household nostructure_notexture_far"
    " nostructure_notexture_near_withloop nostructure_texture_far nostructure_texture_near_withloop"
    " sitting_halfsphere sitting_rpy sitting_static sitting_xyz structure_notexture_far structure_notexture_near"
    " structure_texture_far structure_texture_near teddy walking_halfsphere walking_rpy walking_static walking_xyz",
}
_WITHOUT_VALIDATION = {
    "freiburg1_floor",
    "freiburg1_teddy",
    "freiburg2_large_no_loop",
    "freiburg2_large_with_loop",
    "freiburg2_coke",
    "freiburg2_dishes",
    "freiburg2_flowerbouquet",
    "freiburg2_flowerbouquet_brownbackground",
    "freiburg2_metallic_sphere",
    "freiburg2_metallic_sphere2",
    "freiburg2_pioneer_slam",
    "freiburg2_pioneer_slam2",
    "freiburg2_pioneer_slam3",
    "freiburg3_teddy",
}
_BASE_NAMES = [f"{camera}_{tail}" for camera, tails in _SEQUENCES.items() for tail in tails.split()]

SEQUENCES: tuple[str, ...] = tuple(
    _PREFIX + name
    for name in _BASE_NAMES + [f"{name}_validation" for name in _BASE_NAMES if name not in _WITHOUT_VALIDATION]
)
"""Full names of all sequences of the benchmark, which are the names of their folders."""

_PEOPLE = ("sitting", "walking")
"""First words of the names of sequences with moving people, which are all of camera 3."""

PAPER_SEQUENCES: tuple[str, ...] = tuple(
    f"{_PREFIX}freiburg3_{people}_{motion}" for people in _PEOPLE for motion in ("xyz", "halfsphere", "static", "rpy")
)
"""Full names of the eight sequences of the paper's evaluation (Sec. IV)."""

_ABBREVIATIONS = {
    "s": "sitting",
    "sit": "sitting",
    "w": "walking",
    "walk": "walking",
    "half": "halfsphere",
    "hs": "halfsphere",
    "stat": "static",
    "str": "structure",
    "nstr": "nostructure",
    "tex": "texture",
    "ntex": "notexture",
    "val": "validation",
}
"""Full words for the abbreviations in a name."""

_SHORT_TAILS = {
    "office": "long_office_household",
    "long_office": "long_office_household",
    "person": "desk_with_person",
    "desk_person": "desk_with_person",
    "large_loop": "large_with_loop",
    "nostructure_notexture_near": "nostructure_notexture_near_withloop",
    "nostructure_texture_near": "nostructure_texture_near_withloop",
}
"""Full forms for the short forms of a tail, the part of a name after the camera."""


def canonical_name(name: str) -> str | None:
    """Full name of a TUM sequence from any common spelling.

    The camera can be left out for the sequences of sitting and walking people only: a name such as ``room`` or
    ``office`` is too common to mean a sequence of the benchmark.

    Args:
        name: Name such as ``fr3/w/xyz``, ``fr3_walking_xyz``, ``freiburg3-walking-xyz``, ``walking_xyz`` or the full
            name.

    Returns:
        Full name such as ``rgbd_dataset_freiburg3_walking_xyz``; None if no sequence has this name.
    """
    text = re.sub(r"[\s/\\.\-_]+", "_", name.strip().lower()).strip("_").removeprefix("tum_").removeprefix(_PREFIX)
    match = re.fullmatch(r"(?:(?:freiburg|fr)_?([123])_)?(.+)", text)
    if match is None:
        return None
    words = [_ABBREVIATIONS.get(word, word) for word in match[2].split("_")]
    if match[1] is None and words[0] not in _PEOPLE:
        return None
    validation = ["validation"] if words[-1] == "validation" else []
    tail = "_".join(words[: len(words) - len(validation)])
    full = "_".join([f"{_PREFIX}freiburg{match[1] or 3}", _SHORT_TAILS.get(tail, tail), *validation])
    return full if full in SEQUENCES else None


def short_name(name: str) -> str:
    """Short name of a TUM sequence, such as ``fr3/w/xyz`` or ``fr1/desk``. Any other name is returned unchanged."""
    full = canonical_name(name)
    if full is None:
        return name
    camera, tail = full.removeprefix(_PREFIX).replace("freiburg", "fr").split("_", maxsplit=1)
    tail = re.sub(r"^(s|w)(?:itting|alking)_", r"\1/", tail).replace("/halfsphere", "/half")
    return f"{camera}/{tail}"


def folder_label(folder: str) -> str:
    """Name of a sequence in tables, from the name of its folder.

    A folder is renamed only if its name contains the camera: ``walking_xyz`` can be a recording of the user.

    Args:
        folder: Name of the folder.

    Returns:
        Short name if the folder has the name of a TUM sequence with its camera; the name of the folder otherwise.
    """
    return short_name(folder) if re.search(r"fr(?:eiburg)?[^a-z0-9]*[123]", folder.lower()) else folder


def find_paper_sequence(name: str) -> str | None:
    """Find the sequence of the paper that a text or a path names.

    Args:
        name: Name or path, such as ``fr3/w/xyz``, ``results/fr3_w_xyz/latest/trajectory.txt`` or
            ``freiburg3_walking_xyz``.

    Returns:
        Short name, such as ``fr3/w/xyz``; None if the text names no sequence of the paper, or several.
    """
    pattern = r"(?:freiburg|fr)_?3[/_-][a-z]+[/_-](?:xyz|half(?:sphere)?|static|rpy)(?![a-z]|_?validation)"
    candidates = {canonical_name(text) for text in [name, *re.findall(pattern, name.lower())]}
    found = [sequence for sequence in PAPER_SEQUENCES if sequence in candidates]
    return short_name(found[0]) if len(found) == 1 else None


def download_url(full_name: str) -> str:
    """URL of a sequence's archive on the benchmark's server."""
    camera = full_name.removeprefix(_PREFIX).split("_")[0]
    return f"https://cvg.cit.tum.de/rgbd/dataset/{camera}/{full_name}.tgz"


def unknown_name_error(name: str, folders: Iterable[str]) -> InputError:
    """Create the error for a name that is not a path or a sequence; it suggests similar names.

    Args:
        name: Name as it was given.
        folders: Names and paths of folders that could be meant.
    """
    choices = {short_name(full): full for full in SEQUENCES}
    spellings = {spelling: short for short, full in choices.items() for spelling in (short, full)}
    spellings |= {name: name for name in BUILT_IN_SEQUENCES}
    similar = difflib.get_close_matches(name.strip().lower(), spellings, n=3, cutoff=0.5)
    last = PurePath(name).name
    near = [folder for folder in folders if difflib.get_close_matches(last, [PurePath(folder).name], cutoff=0.75)]
    names = list(dict.fromkeys([*near, *(spellings[spelling] for spelling in similar)]))[:3]
    return InputError(
        f"{name}: is not a file, a folder or the name of a sequence; did you mean"
        f" {' or '.join(names or ['demo', 'fr3/w/xyz'])}?"
    )
