"""Conversion of depth images to metres, from floating point or from whole numbers with a depth scale, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import InputError

STORED_UNIT = 0.0002
"""Unit of depth that the system stores in 16 bits, metres: the unit of TUM's depth images, which divides the
millimetre. The maximum is 13 m, beyond the range of RGB-D cameras."""

SATURATED_DEPTH = np.iinfo(np.uint16).max
"""Largest 16-bit depth value. No camera measures this value, and some datasets write it for missing depth."""

_MIN_MEDIAN, _MAX_MEDIAN = 0.05, 50.0
"""Plausible range of the median depth of an image, metres: wider than the range of any RGB-D camera, so that only a
wrong unit gives values outside of it."""

_MAX_METRES = 1e4
"""Floating-point depth above this is not a measurement, metres: renderers write such values for the sky."""


def depth_to_metres(depth: NDArray[Any], depth_scale: float | None) -> Tensor:
    """Convert a depth image to metres.

    Args:
        depth: Depth image, shape (H, W): metres in floating point, or whole numbers in units of the depth scale. Values
            that are not positive or not finite, the largest value of uint16, and floating-point depth above 10 km are
            not measurements.
        depth_scale: Units per metre of whole numbers; None only for floating point.

    Returns:
        Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.

    Raises:
        InputError: If the image has whole numbers and no depth scale is given.
    """
    if depth.dtype.kind == "f":
        with np.errstate(over="ignore"):
            metres = depth.astype(np.float32, order="C")
        missing = ~((metres > 0) & (metres <= _MAX_METRES))
    else:
        if depth_scale is None:
            raise InputError("depth has whole numbers, and its unit is not stated; give the camera a depth_scale")
        metres = np.divide(depth, np.float32(depth_scale), dtype=np.float32, order="C")
        missing = depth < 0 if depth.dtype.kind == "i" else depth == missing_value(depth)
    if missing.any():
        metres[missing] = 0
    return torch.from_numpy(metres).unsqueeze(0)


def depth_to_units(depth: Tensor, depth_scale: float) -> tuple[NDArray[np.uint16], int]:
    """Convert depth to a 16-bit image of whole numbers.

    Args:
        depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        depth_scale: Units per metre.

    Returns:
        Depth image, uint16, shape (H, W), and the number of pixels whose depth does not fit into 16 bits: they are 0,
        because the largest value would be a wrong measurement.
    """
    units = np.rint(depth[0].numpy() * depth_scale)
    is_out_of_range = units >= SATURATED_DEPTH
    units[is_out_of_range] = 0
    return units.astype(np.uint16), int(is_out_of_range.sum())


def missing_value(depth: NDArray[np.integer[Any]]) -> int:
    """Return the value of pixels without measurement in an image of this type."""
    return SATURATED_DEPTH if depth.dtype.kind == "u" and depth.dtype.itemsize == 2 else 0


def implausible_median(depth: Tensor) -> float | None:
    """Return the median depth of an image, metres, if it shows that the unit is wrong; else None.

    Args:
        depth: Depth, metres, any shape; values that are not positive are not measurements.
    """
    measured = depth[depth > 0]
    median = float(measured.median()) if len(measured) else 1.0
    return None if _MIN_MEDIAN < median < _MAX_MEDIAN else median
