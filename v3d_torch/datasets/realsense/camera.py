"""Import of librealsense, and conversion of its intrinsics to a `PinholeCamera`."""

from __future__ import annotations

import importlib
from typing import Any

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.distortion import DistortionModel


def import_librealsense(source: str) -> Any:
    """Import ``pyrealsense2``, which is not available on all platforms.

    Args:
        source: Name of the camera or file, for error messages.

    Raises:
        InputError: If the library is missing or cannot be loaded; the message contains the command that installs it.
    """
    try:
        return importlib.import_module("pyrealsense2")
    except ModuleNotFoundError as error:
        raise InputError(f"{source}: RealSense needs pyrealsense2 ({error}); run pip install pyrealsense2") from error
    except ImportError as error:  # installed, but a system library is missing
        raise InputError(
            f"{source}: pyrealsense2 cannot be loaded ({error}); on Debian or Ubuntu run apt install libusb-1.0-0"
        ) from error


def depth_scale_from(depth_unit: float) -> float:
    """Return the units per metre for a depth unit in metres, rounded because librealsense gives it in float32."""
    return 1 / float(f"{depth_unit:.6g}")


def camera_from_intrinsics(name: str, intrinsics: Any, depth_unit: float) -> PinholeCamera:
    """Build the camera model of a RealSense stream.

    Args:
        name: Name of the stream, for error messages.
        intrinsics: ``rs.intrinsics`` of the colour stream.
        depth_unit: Length of one unit of depth, metres.

    Raises:
        InputError: If the distortion model is not supported.
    """
    coefficients, model = _distortion(name, intrinsics)
    return PinholeCamera(
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.ppx,
        cy=intrinsics.ppy,
        width=intrinsics.width,
        height=intrinsics.height,
        distortion=coefficients,
        depth_scale=depth_scale_from(depth_unit),
        distortion_model=model,
    )


def _distortion(name: str, intrinsics: Any) -> tuple[tuple[float, ...], DistortionModel]:
    """Coefficients and distortion model."""
    rs = import_librealsense(name)
    coefficients = tuple(float(value) for value in intrinsics.coeffs)
    if intrinsics.model == rs.distortion.kannala_brandt4:
        return coefficients[:4], "equidistant"
    # librealsense undistorts inverse_brown_conrady like brown_conrady, to within a hundredth of a pixel.
    supported = (rs.distortion.brown_conrady, rs.distortion.inverse_brown_conrady)
    if any(coefficients) and intrinsics.model not in supported:
        raise InputError(f"{name}: has the unsupported distortion model {intrinsics.model.name}; pass --camera")
    return coefficients, "plumb_bob"
