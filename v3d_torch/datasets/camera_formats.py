"""Camera files of other programs: ORB-SLAM2 and 3, Kalibr, ROS and OpenCV, and plain numbers.

Each reader returns the fields of `v3d_torch.geometry.camera.PinholeCamera` that the file states, unchecked.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from v3d_torch.errors import InputError
from v3d_torch.geometry.distortion import COEFFICIENTS, DistortionModel
from v3d_torch.io.text_file import replace_odd_spaces

Fields = dict[str, Any]

_OWN_KEYS = ("depth_scale", "readout", "depth_delay", "inverse_depth_offset")
"""Fields that can be added to the files of other programs, which do not state them."""

_KALIBR_CAMERA = re.compile(r"cam\d+")

_LENS_KEYS = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distortion", "dist", "d")
"""Names of the distortion coefficients in files of ROS and OpenCV, see `_plain`."""


def fields_from_yaml(tree: Mapping[Any, Any], source: str) -> Fields | None:
    """Return the fields of a camera in a YAML file of another program.

    Args:
        tree: Content of the file.
        source: Origin of the file, for messages.

    Returns:
        Fields, which can lack the size of the images; None if the file has none of the known formats.

    Raises:
        InputError: If the file contains several cameras, is incomplete, or names the distortion in an unknown way.
    """
    names = {str(key) for key in tree}
    keys = {_plain(key): value for key, value in tree.items()}
    own = {key: tree[key] for key in _OWN_KEYS if key in tree}
    try:
        if any(name.startswith(("Camera.", "Camera1.")) for name in names):
            return _orb_slam(tree) | own
        if cameras := {name: tree[name] for name in tree if _KALIBR_CAMERA.fullmatch(str(name))}:
            if len(cameras) > 1:
                raise InputError(
                    f"{source}: contains {len(cameras)} cameras ({', '.join(cameras)}); keep only the colour camera"
                )
            return _kalibr(next(iter(cameras.values())), source) | own
        if "intrinsics" in names and "resolution" in names:
            return _kalibr(tree, source) | own
        if "cameramatrix" in keys or ("k" in keys and "width" in keys):
            _check_lens_keys(tree, source)
            return _ros(keys) | own
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{source}: is an incomplete camera file ({_describe(error)}); export it again") from error
    return None


def fields_from_numbers(text: str, source: str) -> Fields:
    """Return the fields of a camera in a text of numbers.

    Args:
        text: ``fx fy cx cy``, ``fx fy cx cy width height``, ``fx fy cx cy depth_scale width height``, or a 3x3 camera
            matrix; commas and comments are accepted.
        source: Origin of the text, for messages.

    Raises:
        InputError: If the numbers do not form a camera.
    """
    words = re.sub(r"#.*", "", replace_odd_spaces(text)).replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(
            f"{source}: contains a value that is not a number ({error}); write fx fy cx cy depth_scale width height"
        ) from error
    if len(numbers) == 9 and numbers[1] == numbers[3] == numbers[6] == numbers[7] == 0.0 and numbers[8] == 1.0:
        numbers = [numbers[0], numbers[4], numbers[2], numbers[5]]
    names = {
        4: ("fx", "fy", "cx", "cy"),
        6: ("fx", "fy", "cx", "cy", "width", "height"),
        7: ("fx", "fy", "cx", "cy", "depth_scale", "width", "height"),
    }.get(len(numbers))
    if names is None:
        raise InputError(
            f"{source}: contains {len(numbers)} numbers that do not form a camera; write fx fy cx cy depth_scale width"
            " height, or a 3x3 camera matrix without skew"
        )
    return dict(zip(names, numbers, strict=True))


def _orb_slam(tree: Mapping[Any, Any]) -> Fields:
    """Fields of settings of ORB-SLAM2 and 3, with keys such as ``Camera.fx`` or ``Camera1.fx``."""
    prefix = "Camera1." if "Camera1.fx" in tree else "Camera."
    fields: Fields = {name: tree[prefix + name] for name in ("fx", "fy", "cx", "cy")}
    fields |= {name: tree[f"Camera.{name}"] for name in ("width", "height") if f"Camera.{name}" in tree}
    model: DistortionModel = "equidistant" if tree.get("Camera.type") == "KannalaBrandt8" else "plumb_bob"
    coefficients = [_number(tree.get(prefix + name, 0.0)) for name in COEFFICIENTS[model]]
    fields |= {"distortion": coefficients, "distortion_model": model}
    for name in ("DepthMapFactor", "RGBD.DepthMapFactor"):
        if name in tree:
            fields["depth_scale"] = tree[name]
    return fields


def _kalibr(camera: Mapping[str, Any], source: str) -> Fields:
    """Fields of one camera of a camchain of Kalibr."""
    if camera.get("camera_model", "pinhole") != "pinhole":
        raise InputError(
            f"{source}: has the camera model {camera['camera_model']}, which is not supported; calibrate with"
            " pinhole-radtan or pinhole-equi"
        )
    fx, fy, cx, cy = camera["intrinsics"]
    width, height = camera["resolution"]
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height} | {
        "distortion": [_number(value) for value in camera.get("distortion_coeffs", [])],
        "distortion_model": str(camera.get("distortion_model", "none")),
    }


def _ros(keys: Mapping[str, Any]) -> Fields:
    """Fields of a ``CameraInfo`` of ROS or a calibration of OpenCV; keys in lower case without underscores."""
    K = _numbers(keys.get("cameramatrix", keys.get("k")))
    if len(K) != 9 or (any(K) and K[6:] != [0.0, 0.0, 1.0]):  # ROS writes zeros for a camera that is not calibrated
        raise ValueError("the camera matrix is not 3x3 with the last row 0 0 1")
    D = _numbers(next((keys[name] for name in _LENS_KEYS if name in keys), []))
    fields: Fields = {"fx": K[0], "fy": K[4], "cx": K[2], "cy": K[5]}
    for name in ("width", "height"):
        if (value := keys.get(f"image{name}", keys.get(name))) is not None:
            fields[name] = value
    model = "equidistant" if keys.get("fisheyemodel") else keys.get("distortionmodel", "plumb_bob")
    return fields | {"distortion": D, "distortion_model": str(model or "")}


def _check_lens_keys(tree: Mapping[Any, Any], source: str) -> None:
    """Check that no key with an unknown name can be the distortion, which would be ignored."""
    known = (*_LENS_KEYS, "distortionmodel")
    unknown = next((key for key in tree if re.match("dist(?!ance)", _plain(key)) and _plain(key) not in known), None)
    if unknown is not None:
        raise InputError(
            f"{source}: has an unknown key {unknown}; name the coefficients of the lens distortion_coefficients, and"
            " its model distortion_model"
        )


def _plain(key: object) -> str:
    return str(key).lower().replace("_", "")


def _numbers(node: Any) -> list[float]:
    """Numbers of a list, of a list of rows, or of a matrix with the key ``data``."""
    rows = node["data"] if isinstance(node, Mapping) else node
    return [_number(value) for row in rows for value in (row if isinstance(row, list) else [row])]


def _number(value: Any) -> float:
    if isinstance(value, bool):
        raise ValueError(f"{value} is not a number")
    return float(value)  # YAML reads numbers such as 1e-05, which have no decimal point, as text


def _describe(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
