"""Camera parameters from files (``camera.yaml``, ``K.txt``) and presets of the package."""

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
from v3d_torch.geometry.camera import MAX_DEPTH_DELAY, MAX_INVERSE_DEPTH_OFFSET, MAX_READOUT, PinholeCamera
from v3d_torch.io.paths import expand_user
from v3d_torch.io.safe_yaml import parse_yaml
from v3d_torch.io.text import read_text

_PRESETS = resources.files("v3d_torch.datasets") / "presets"
PRESETS: tuple[str, ...] = tuple(
    sorted(entry.name.removesuffix(".yaml") for entry in _PRESETS.iterdir() if entry.name.endswith(".yaml"))
)
"""Names of the cameras that come with the package, see `load_camera`."""

CameraChoice = str | Path | PinholeCamera | None
"""Camera chosen by the user: a camera, the name of a preset or a file; None for the camera of the sequence."""

_Focal = Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
_Pixels = Annotated[int, Field(gt=0, le=1 << 13)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _CameraFile(BaseModel):
    """Fields of a ``camera.yaml``. Fields whose default would be silently wrong for other cameras are required."""

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
    depth_delay: Annotated[float, Field(ge=-MAX_DEPTH_DELAY, le=MAX_DEPTH_DELAY)] = 0.0
    inverse_depth_offset: Annotated[float, Field(ge=-MAX_INVERSE_DEPTH_OFFSET, le=MAX_INVERSE_DEPTH_OFFSET)] = 0.0


def load_camera(path_or_name: str | Path) -> PinholeCamera:
    """Load a camera from a file or a preset.

    Args:
        path_or_name: Name of a preset (`PRESETS`, such as ``tum_fr3``), or path of a file. A YAML file contains the
            fields of `PinholeCamera` by name. Any other file contains numbers: ``fx fy cx cy depth_scale width
            height``, or a 3x3 camera matrix of images with 640x480 pixels and 5000 depth units per metre.

    Raises:
        InputError: If there is no such preset or file, or the file does not contain a valid camera.
    """
    if str(path_or_name) in PRESETS:
        return _from_yaml((_PRESETS / f"{path_or_name}.yaml").read_text(encoding="utf-8"), str(path_or_name))
    path = expand_user(path_or_name)
    if not path.is_file():
        similar = difflib.get_close_matches(str(path_or_name), PRESETS, n=1, cutoff=0.6)
        hint = f"did you mean {similar[0]}?" if similar else f"the presets are {', '.join(PRESETS)}"
        raise InputError(f"{path_or_name}: is not a camera file or preset; {hint}")
    text = read_text(path, "a camera is a YAML file or a K.txt")
    return _from_yaml(text, str(path)) if path.suffix in (".yaml", ".yml") else _from_numbers(text, str(path))


def choose_camera(camera: CameraChoice, folder: Path, published: PinholeCamera | None = None) -> PinholeCamera:
    """Choose the camera of a sequence.

    The first one available is used: the user's choice, ``camera.yaml`` or ``K.txt`` in the folder, the published camera
    of the dataset, the TUM preset for the folder's name (``freiburg1``, ``fr2``, ...).

    Args:
        camera: Camera chosen by the user.
        folder: Folder of the sequence.
        published: Camera of the dataset, if all its sequences have the same.

    Raises:
        InputError: If there is no camera, or the camera is invalid.
    """
    if isinstance(camera, PinholeCamera):
        return camera
    chosen = _find_camera(camera, folder, published)
    if not _is_invertible_at_corners(chosen):
        raise InputError(
            f"{camera or folder}: the distortion {chosen.distortion} cannot be inverted at the image corners; correct"
            " the camera's distortion (k1, k2, p1, p2, k3) or remove it"
        )
    return chosen


def _find_camera(camera: str | Path | None, folder: Path, published: PinholeCamera | None) -> PinholeCamera:
    if camera is not None and not isinstance(camera, str | os.PathLike):
        raise InputError(f"camera is a {type(camera).__name__}; pass a PinholeCamera, the name of a preset or a file")
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
        f"{folder}: has no camera parameters; add a camera.yaml (fx, fy, cx, cy, width, height, depth_scale) or pass"
        f" --camera with a file or one of {', '.join(PRESETS)}"
    )


def _from_yaml(text: str, source: str) -> PinholeCamera:
    try:
        tree = parse_yaml(text)
    except ValueError as error:
        raise InputError(f"{source}: is not valid YAML ({error}); repair it") from error
    if not isinstance(tree, dict):
        raise InputError(
            f"{source}: does not contain a camera; write fx, fy, cx, cy, width, height, depth_scale as keys"
        )
    return camera_from_fields(tree, source)


def _from_numbers(text: str, source: str) -> PinholeCamera:
    words = re.sub(r"#.*", "", text).replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(
            f"{source}: contains a value that is not a number ({error}); write fx fy cx cy depth_scale width height"
        ) from error
    if len(numbers) == 7:
        fx, fy, cx, cy, depth_scale, width, height = numbers
    elif len(numbers) == 9 and numbers[1] == numbers[3] == numbers[6] == numbers[7] == 0.0 and numbers[8] == 1.0:
        fx, cx, fy, cy = numbers[0], numbers[2], numbers[4], numbers[5]
        depth_scale, width, height = PinholeCamera.depth_scale, PinholeCamera.width, PinholeCamera.height
    else:
        raise InputError(
            f"{source}: contains {len(numbers)} numbers that do not form a camera; write fx fy cx cy depth_scale width"
            " height, or a 3x3 camera matrix without skew"
        )
    fields = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height, "depth_scale": depth_scale}
    return camera_from_fields(fields, source)


def camera_from_fields(fields: dict[Any, Any], source: str) -> PinholeCamera:
    """Create a camera from unchecked fields.

    Args:
        fields: Fields of `PinholeCamera` by name.
        source: Origin of the fields, for messages.

    Raises:
        InputError: If a field is missing, unknown or out of range.
    """
    try:
        camera = PinholeCamera(**_CameraFile.model_validate(fields).model_dump())
    except ValidationError as error:
        raise InputError(f"{source}: {first_error(error)}; correct the camera") from error
    if not (-camera.width <= camera.cx <= 2 * camera.width and -camera.height <= camera.cy <= 2 * camera.height):
        raise InputError(
            f"{source}: the principal point ({camera.cx:g}, {camera.cy:g}) is far outside the"
            f" {camera.width}x{camera.height} image; correct cx and cy, or width and height"
        )
    return camera


def _is_invertible_at_corners(camera: PinholeCamera) -> bool:
    """Check whether undistortion inverts distortion at the image corners. Invalid coefficients fold rays back there."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    corners = torch.tensor([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    projected = camera.distort(camera.undistort(corners))
    return bool(((projected - corners).abs() < 1).all())
