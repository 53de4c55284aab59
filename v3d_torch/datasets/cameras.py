"""Choice of the camera of a sequence: camera files, presets of the package, published cameras."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

from v3d_torch.datasets.camera_fields import camera_from_fields, check_distortion, check_principal_point
from v3d_torch.datasets.camera_formats import fields_from_numbers, fields_from_yaml
from v3d_torch.datasets.sequence_names import canonical_name
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.paths import expand_user
from v3d_torch.io.safe_yaml import parse_yaml, to_valid_yaml
from v3d_torch.io.text_file import read_text

_PRESETS = resources.files("v3d_torch.datasets") / "presets"
PRESETS: tuple[str, ...] = tuple(
    sorted(entry.name.removesuffix(".yaml") for entry in _PRESETS.iterdir() if entry.name.endswith(".yaml"))
)
"""Names of the cameras that come with the package, see `load_camera`."""

CameraChoice = str | Path | PinholeCamera | None
"""Camera chosen by the user: a camera, the name of a preset or a file; None for the camera of the sequence."""

ImageSize = Callable[[], tuple[int, int]]
"""Function that returns width and height of the images of a sequence."""

PublishedCamera = Callable[[], PinholeCamera | None]
"""Function that returns the camera that a data set or a recording states; None if it states none."""

_DEFAULT_SIZE = (PinholeCamera.width, PinholeCamera.height)


def load_camera(path_or_name: str | Path, image_size: ImageSize | None = None) -> PinholeCamera:
    """Load a camera from a file or a preset.

    Args:
        path_or_name: Name of a preset (`PRESETS`, such as ``tum_fr3``), or path of a file. A YAML file contains the
            fields of `PinholeCamera` by name, or is a camera file of ORB-SLAM2 or 3, Kalibr, ROS or OpenCV. Any other
            file contains numbers: ``fx fy cx cy depth_scale width height``, or a 3x3 camera matrix.
        image_size: Function that gives the size of the images for a file that does not state it; None for 640x480.

    Returns:
        The camera; its ``depth_scale`` is None if the file does not state it.

    Raises:
        InputError: If there is no such preset or file, or the file does not contain a valid camera.
    """
    if str(path_or_name) in PRESETS:
        return _from_yaml((_PRESETS / f"{path_or_name}.yaml").read_text(encoding="utf-8"), str(path_or_name), None)
    path = expand_user(path_or_name)
    if not path.is_file():
        similar = difflib.get_close_matches(str(path_or_name), PRESETS, n=1, cutoff=0.6)
        hint = f"did you mean {similar[0]}?" if similar else f"the presets are {', '.join(PRESETS)}"
        raise InputError(f"{path_or_name}: is not a camera file or preset; {hint}")
    text = read_text(path, "a camera is a YAML file or a K.txt")
    parse = _from_yaml if path.suffix.lower() in (".yaml", ".yml") else _from_numbers
    return parse(text, str(path), image_size)


def choose_camera(
    camera: CameraChoice,
    folder: Path,
    published: PublishedCamera | None = None,
    *,
    depth_scale: float | None = None,
    image_size: ImageSize | None = None,
) -> PinholeCamera:
    """Choose the camera of a sequence.

    The first one available is used: the user's choice, ``camera.yaml`` or ``K.txt`` in the folder, the published camera
    of the dataset, the TUM preset for the folder's name (``freiburg1``, ``fr2``, ...).

    Args:
        camera: Camera chosen by the user.
        folder: Folder of the sequence.
        published: Function that gives the camera of the dataset or the recording, which can raise InputError; called
            only if the camera or its depth scale is needed.
        depth_scale: Depth units per metre that the layout prescribes, for a camera that does not state them; None for
            those of the published camera, or of the TUM benchmark if the folder is named like one of its sequences.
        image_size: Function that gives the size of the images for a camera file that does not state it.

    Returns:
        The camera. Its ``depth_scale`` is None if neither the camera nor the dataset states it.

    Raises:
        InputError: If there is no camera, or the camera is invalid.
    """
    stated: PublishedCamera = published or (lambda: None)
    if camera is not None:
        chosen = load_given_camera(camera, image_size)
    else:
        file = camera_file(folder)
        chosen = load_camera(file, image_size) if file is not None else _published_camera(folder, stated)
        check_distortion(chosen, folder if file is None else file)
    if chosen.depth_scale is not None:
        return chosen
    if depth_scale is None:
        is_tum = canonical_name(folder.resolve().name) is not None
        known = stated() or (_tum_preset(folder) if is_tum else None)
        depth_scale = known.depth_scale if known is not None else None
    return replace(chosen, depth_scale=depth_scale)


def camera_file(folder: Path) -> Path | None:
    """Return the camera file in a folder, ``camera.yaml`` or ``K.txt``; None if there is none."""
    return next((folder / name for name in ("camera.yaml", "K.txt") if (folder / name).is_file()), None)


def load_given_camera(camera: str | Path | PinholeCamera, image_size: ImageSize | None = None) -> PinholeCamera:
    """Return the camera that the user gave as a camera, the name of a preset or a file.

    Args:
        camera: Camera, or what `load_camera` loads.
        image_size: Function that gives the size of the images for a camera file that does not state it.

    Returns:
        The camera; its ``depth_scale`` is None if it is not stated.

    Raises:
        InputError: If the camera is of another type or invalid.
    """
    if isinstance(camera, PinholeCamera):
        return camera
    if not isinstance(camera, str | os.PathLike):
        raise InputError(f"camera is a {type(camera).__name__}; pass a PinholeCamera, the name of a preset or a file")
    loaded = load_camera(camera, image_size)
    check_distortion(loaded, camera)
    return loaded


def _published_camera(folder: Path, published: PublishedCamera) -> PinholeCamera:
    """Return the camera of the data set or the recording, else the preset for the folder's name."""
    camera = published() or _tum_preset(folder)
    if camera is not None:
        return camera
    raise InputError(
        f"{folder}: has no camera parameters; add a camera.yaml (fx, fy, cx, cy, width, height, depth_scale) or pass"
        f" --camera with a file or one of {', '.join(PRESETS)}"
    )


def _tum_preset(folder: Path) -> PinholeCamera | None:
    """Camera of a sequence of the TUM RGB-D benchmark, by the name of its folder; None for other names."""
    match = re.search(r"(?:freiburg|fr)_?([123])(?!\d)", folder.resolve().name.lower())
    return load_camera(f"tum_fr{match[1]}") if match else None


def _from_yaml(text: str, source: str, image_size: ImageSize | None) -> PinholeCamera:
    try:
        tree = parse_yaml(to_valid_yaml(text))
    except ValueError as error:
        raise InputError(f"{source}: is not valid YAML ({error}); repair it") from error
    if not isinstance(tree, dict):
        raise InputError(
            f"{source}: does not contain a camera; write fx, fy, cx, cy, width, height, depth_scale as keys"
        )
    fields = fields_from_yaml(tree, source)
    return camera_from_fields(tree, source) if fields is None else _complete(fields, source, image_size)


def _from_numbers(text: str, source: str, image_size: ImageSize | None) -> PinholeCamera:
    return _complete(fields_from_numbers(text, source), source, image_size)


def _complete(fields: dict[str, Any], source: str, image_size: ImageSize | None) -> PinholeCamera:
    """Create a camera from fields that can lack the size of the images."""
    if "width" in fields and "height" in fields:
        return camera_from_fields(fields, source)
    width, height = _DEFAULT_SIZE if image_size is None else image_size()
    camera = camera_from_fields(fields | {"width": width, "height": height}, source)
    if image_size is None:
        return camera
    check_principal_point(camera.cx, camera.cy, (width, height), source)
    return camera
