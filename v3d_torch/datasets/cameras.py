"""Cameras from files: ``camera.yaml``, ``K.txt`` and the presets that come with the package."""

from __future__ import annotations

import difflib
import os
import re
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from v3d_torch.config.validation import first_error
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.io.paths import expand_user
from v3d_torch.io.safe_yaml import parse_yaml
from v3d_torch.io.text import read_text

_PRESETS = resources.files("v3d_torch.datasets") / "presets"
PRESETS: tuple[str, ...] = tuple(
    sorted(entry.name.removesuffix(".yaml") for entry in _PRESETS.iterdir() if entry.name.endswith(".yaml"))
)
"""Names that `load_camera` knows without a file."""

CameraChoice = str | Path | PinholeCamera | None
"""What a user may say of the camera: itself, a preset's name or a file; None leaves it to the sequence."""

_Focal = Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
_Pixels = Annotated[int, Field(gt=0, le=1 << 13)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _CameraFile(BaseModel):
    """The keys of a ``camera.yaml``; no default for what would be wrong without a word on another camera."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fx: _Focal
    fy: _Focal
    cx: _Finite
    cy: _Finite
    width: _Pixels
    height: _Pixels
    distortion: tuple[_Finite, _Finite, _Finite, _Finite, _Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
    readout: Annotated[float, Field(ge=-MAX_READOUT, le=MAX_READOUT)] | None = None


def load_camera(path_or_name: str | Path) -> PinholeCamera:
    """Read a camera.

    Args:
        path_or_name: a preset (`PRESETS`, such as ``tum_fr3``), or a file. ``*.yaml`` holds the fields of
            `PinholeCamera` by name. Any other file holds numbers: ``fx fy cx cy depth_scale width height``, or a 3x3
            camera matrix, then of 640x480 pixels and 5000 depth units per metre.

    Raises:
        InputError: neither a preset nor a file, or a file without a camera in it.
    """
    if str(path_or_name) in PRESETS:
        return _from_yaml((_PRESETS / f"{path_or_name}.yaml").read_text(encoding="utf-8"), str(path_or_name))
    path = expand_user(path_or_name)
    if not path.is_file():
        near = difflib.get_close_matches(str(path_or_name), PRESETS, n=1, cutoff=0.6)
        hint = f"did you mean {near[0]}?" if near else f"the presets are {', '.join(PRESETS)}"
        raise InputError(f"{path_or_name}: is neither a camera file nor a preset; {hint}")
    text = read_text(path, "a camera is a YAML file or a K.txt")
    return _from_yaml(text, str(path)) if path.suffix in (".yaml", ".yml") else _from_numbers(text, str(path))


def choose_camera(camera: CameraChoice, folder: Path, published: PinholeCamera | None = None) -> PinholeCamera:
    """The camera that the user names, else the one of the sequence's folder.

    Args:
        camera: the user's choice.
        folder: its ``camera.yaml`` or ``K.txt`` is taken, else what its dataset says, else the TUM camera that its
            name tells.
        published: the camera of the dataset that the folder belongs to, where all its sequences have one.

    Raises:
        InputError: nothing says what the camera is, or what says it is wrong.
    """
    if isinstance(camera, PinholeCamera):
        return camera
    chosen = _named_or_own(camera, folder, published)
    if not _is_seen_through(chosen):
        raise InputError(
            f"{camera or folder}: no point is seen at some corner of the image with the lens {chosen.distortion};"
            " correct the camera's distortion (k1, k2, p1, p2, k3) or leave it out"
        )
    return chosen


def _named_or_own(camera: str | Path | None, folder: Path, published: PinholeCamera | None) -> PinholeCamera:
    if camera is not None and not isinstance(camera, str | os.PathLike):
        raise InputError(f"the camera is a {type(camera).__name__}; give a PinholeCamera, a preset's name or a file")
    if camera is not None:
        return load_camera(camera)
    for name in ("camera.yaml", "K.txt"):
        if (folder / name).is_file():
            return load_camera(folder / name)
    if published is not None:
        return published
    if match := re.search(r"(?:freiburg|fr)_?([123])(?!\d)", folder.resolve().name.lower()):
        return load_camera(f"tum_fr{match[1]}")
    raise InputError(
        f"{folder}: says nothing about its camera; put a camera.yaml there (fx, fy, cx, cy, width, height, depth_scale)"
        f" or give --camera with a file or one of {', '.join(PRESETS)}"
    )


def _from_yaml(text: str, source: str) -> PinholeCamera:
    try:
        tree = parse_yaml(text)
    except ValueError as error:
        raise InputError(f"{source}: is not valid YAML ({error}); repair it") from error
    if not isinstance(tree, dict):
        raise InputError(f"{source}: holds no camera; write fx, fy, cx, cy, width, height, depth_scale as keys")
    return checked_camera(tree, source)


def _from_numbers(text: str, source: str) -> PinholeCamera:
    words = re.sub(r"#.*", "", text).replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(
            f"{source}: holds something that is not a number ({error}); write fx fy cx cy depth_scale width height"
        ) from error
    if len(numbers) == 7:
        fx, fy, cx, cy, depth_scale, width, height = numbers
    elif len(numbers) == 9 and numbers[1] == numbers[3] == numbers[6] == numbers[7] == 0.0 and numbers[8] == 1.0:
        fx, cx, fy, cy = numbers[0], numbers[2], numbers[4], numbers[5]
        depth_scale, width, height = PinholeCamera.depth_scale, PinholeCamera.width, PinholeCamera.height
    else:
        raise InputError(
            f"{source}: holds {len(numbers)} numbers that are no camera; write fx fy cx cy depth_scale width height,"
            " or a 3x3 camera matrix without skew"
        )
    fields = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height, "depth_scale": depth_scale}
    return checked_camera(fields, source)


def checked_camera(fields: dict[Any, Any], source: str) -> PinholeCamera:
    """A camera from the fields of `PinholeCamera`, read from ``source``.

    Raises:
        InputError: a field is missing, unknown or no such number.
    """
    try:
        camera = PinholeCamera(**_CameraFile.model_validate(fields).model_dump())
    except ValidationError as error:
        raise InputError(f"{source}: {first_error(error)}; correct the camera") from error
    if not (-camera.width <= camera.cx <= 2 * camera.width and -camera.height <= camera.cy <= 2 * camera.height):
        raise InputError(
            f"{source}: the centre ({camera.cx:g}, {camera.cy:g}) lies far outside of {camera.width}x{camera.height}"
            " pixels; correct cx and cy, or the size"
        )
    return camera


def _is_seen_through(camera: PinholeCamera) -> bool:
    """Whether the lens can be undone at the corners: its polynomial bends rays back where its numbers are wrong."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    corners = torch.tensor([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    again = camera.distort(camera.undistort(corners))
    return bool(((again - corners).abs() < 1).all())
