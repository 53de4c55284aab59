"""What librealsense says of a camera, as a `PinholeCamera`."""

from __future__ import annotations

import importlib
from typing import Any

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera


def library(source: str) -> Any:
    """``pyrealsense2``, which some platforms lack.

    Raises:
        InputError: it cannot be imported; the message begins with ``source`` and tells how to get it.
    """
    try:
        return importlib.import_module("pyrealsense2")
    except ModuleNotFoundError as error:
        raise InputError(f"{source}: RealSense needs pyrealsense2 ({error}); pip install pyrealsense2") from error
    except ImportError as error:  # it is there, and lacks what the system should have
        raise InputError(
            f"{source}: pyrealsense2 cannot be loaded ({error}); on Debian or Ubuntu apt install libusb-1.0-0"
        ) from error


def per_metre(depth_unit: float) -> float:
    """Units per metre, from a unit in metres, which cameras give in single precision."""
    return 1 / float(f"{depth_unit:.6g}")


def camera_of(name: str, intrinsics: Any, depth_unit: float) -> PinholeCamera:
    """The camera of a stream's ``intrinsics`` whose depth is counted in ``depth_unit`` metres.

    Raises:
        InputError: its lens is of a kind unknown here; the message begins with ``name``.
    """
    return PinholeCamera(
        *(intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy, intrinsics.width, intrinsics.height),
        _lens(name, intrinsics),
        per_metre(depth_unit),
    )


def _lens(name: str, intrinsics: Any) -> tuple[float, float, float, float, float]:
    """k1, k2, p1, p2, k3 of the Brown model."""
    rs = library(name)
    k1, k2, p1, p2, k3 = (float(value) for value in intrinsics.coeffs)
    # What librealsense calls the inverse model is undone there as the other is, to a hundredth of a pixel.
    known = (rs.distortion.brown_conrady, rs.distortion.inverse_brown_conrady)
    if any((k1, k2, p1, p2, k3)) and intrinsics.model not in known:
        raise InputError(f"{name}: has a lens of the kind {intrinsics.model.name}, not known here; give --camera")
    return k1, k2, p1, p2, k3
