"""Cameras from unchecked fields, as camera files and recordings state them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from v3d_torch.config.validation import first_error, similar_key, to_float
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import (
    MAX_DEPTH_DELAY,
    MAX_INVERSE_DEPTH_OFFSET,
    MAX_READOUT,
    NEGATIVE_FY,
    PinholeCamera,
)
from v3d_torch.geometry.distortion import COEFFICIENTS, DistortionModel

_Focal = Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
_Pixels = Annotated[int, Field(gt=0, le=1 << 13)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]

_MAX_FISHEYE_TANGENT = math.tan(math.radians(85))
"""Maximum tangent of the angle between the ray of a pixel and the optical axis of a fisheye lens; with larger angles,
undistorted pixels are far away from the image."""

DISTORTION_MODELS: Mapping[str, DistortionModel] = {
    **{name: name for name in COEFFICIENTS},
    "": "plumb_bob",
    "none": "plumb_bob",
    "radtan": "plumb_bob",
    "radial-tangential": "plumb_bob",
    "equi": "equidistant",
    "fisheye": "equidistant",
    "kannalabrandt8": "equidistant",
}
"""Distortion models by the names that ROS, Kalibr and ORB-SLAM3 give them, in lower case."""


class _CameraFile(BaseModel):
    """Fields of a ``camera.yaml``. Fields whose default would be silently wrong for other cameras are required."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fx: _Focal
    fy: _Focal
    cx: _Finite
    cy: _Finite
    width: _Pixels
    height: _Pixels
    distortion: tuple[_Finite, ...] = ()
    distortion_model: str | None = None
    depth_scale: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)] | None = None
    readout: Annotated[float, Field(ge=-MAX_READOUT, le=MAX_READOUT)] | None = None
    depth_delay: Annotated[float, Field(ge=-MAX_DEPTH_DELAY, le=MAX_DEPTH_DELAY)] = 0.0
    inverse_depth_offset: Annotated[float, Field(ge=-MAX_INVERSE_DEPTH_OFFSET, le=MAX_INVERSE_DEPTH_OFFSET)] = 0.0


def camera_from_fields(fields: Mapping[Any, Any], source: str) -> PinholeCamera:
    """Create a camera from unchecked fields.

    Args:
        fields: Fields of `PinholeCamera` by name. Four distortion coefficients need a ``distortion_model``, because two
            models have four.
        source: Origin of the fields, for messages.

    Raises:
        InputError: If a field is missing, unknown or out of range.
    """
    for name, value in fields.items():
        if any(isinstance(each, bool) for each in (value if isinstance(value, list | tuple) else (value,))):
            raise InputError(f"{source}: {name}: input should be a number, got {value}; correct the camera")
    if to_float(fields.get("fy")) < 0:
        raise InputError(f"{source}: fy is {fields['fy']}; {NEGATIVE_FY}")
    try:
        checked = _CameraFile.model_validate(dict(fields)).model_dump()
    except ValidationError as error:
        raise InputError(f"{source}: {_describe(error)}") from error
    model, distortion = checked["distortion_model"], checked["distortion"]
    if model is None and 0 < len(distortion) < 5:
        raise InputError(
            f"{source}: distortion has {len(distortion)} numbers; write k1, k2, p1, p2, k3, or state distortion_model:"
            f" one of {', '.join(COEFFICIENTS)}"
        )
    known = DISTORTION_MODELS.get((model or "").lower(), None if any(distortion) else "plumb_bob")
    if known is None:
        raise InputError(
            f"{source}: the distortion model {model} is not supported; calibrate with one of {', '.join(COEFFICIENTS)}"
        )
    try:
        camera = PinholeCamera(**checked | {"distortion_model": known})
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    if not (-camera.width <= camera.cx <= 2 * camera.width and -camera.height <= camera.cy <= 2 * camera.height):
        raise InputError(
            f"{source}: the principal point ({camera.cx:g}, {camera.cy:g}) is far outside the"
            f" {camera.width}x{camera.height} image; correct cx and cy, or width and height"
        )
    return camera


def camera_from_matrix(
    K: NDArray[np.float64], size: tuple[int, int], depth_scale: float | None, source: Path
) -> PinholeCamera:
    """Create a camera without distortion from a camera matrix.

    Args:
        K: Camera matrix, shape (3, 3) or (4, 4).
        size: Width and height of the images.
        depth_scale: Depth units per metre; None if they are not stated.
        source: File of the matrix, for messages.

    Raises:
        InputError: As `camera_from_fields`.
    """
    fields = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": size[0], "height": size[1]}
    return camera_from_fields(fields | {"depth_scale": depth_scale}, str(source))


def _describe(error: ValidationError) -> str:
    """Describe what is wrong with the fields of a camera, and how to correct it; first a key that can be a slip."""
    errors = {each["type"]: str(each["loc"][0]) for each in reversed(error.errors()) if each["loc"]}
    if (unknown := errors.get("extra_forbidden")) is not None:
        near = similar_key(unknown, _CameraFile.model_fields)
        return f"unknown key {unknown}; {'remove it' if near is None else f'did you mean {near}?'}"
    if (missing := errors.get("missing")) is not None:
        return f"{missing} is missing; add it to the camera"
    return f"{first_error(error)}; correct the camera"


def check_principal_point(cx: float, cy: float, size: tuple[int, int], source: object) -> None:
    """Check that the principal point is that of images of a given size: resized images have another one.

    Args:
        cx: Column of the principal point, pixels.
        cy: Row of the principal point, pixels.
        size: Width and height of the images.
        source: Origin of the camera, for messages.

    Raises:
        InputError: If the principal point is far from the centre of the images.
    """
    width, height = size
    if abs(cx - width / 2) > width / 4 or abs(cy - height / 2) > height / 4:
        raise InputError(
            f"{source}: the principal point ({cx:g}, {cy:g}) is far from the centre of the {width}x{height} images;"
            " give the camera of these images, not of a larger or smaller size"
        )


def check_distortion(camera: PinholeCamera, source: object) -> None:
    """Check that undistortion inverts distortion at the image corners, where invalid coefficients fold rays back.

    Args:
        camera: Camera.
        source: Origin of the camera, for messages.

    Raises:
        InputError: If undistortion does not invert distortion.
    """
    right, bottom = camera.width - 1.0, camera.height - 1.0
    corners = torch.tensor([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    undistorted = camera.undistort(corners)
    is_fisheye = camera.distortion_model == "equidistant"
    max_tangent = _MAX_FISHEYE_TANGENT if is_fisheye else math.inf
    is_inverse = (camera.distort(undistorted) - corners).abs().amax(dim=1) < 1
    if bool((is_inverse & (camera.normalise(undistorted).norm(dim=1) < max_tangent)).all()):
        return
    remedy = ", or crop the images to less than 170 degrees" if is_fisheye else " or remove it"
    raise InputError(
        f"{source}: the distortion {camera.distortion} cannot be inverted at the image corners; correct the camera's"
        f" distortion ({', '.join(COEFFICIENTS[camera.distortion_model])}){remedy}"
    )
