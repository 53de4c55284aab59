"""Parameters of a camera that can be calibrated from a map, in groups that are accepted or rejected as a whole."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from v3d_torch.geometry.camera import MAX_INVERSE_DEPTH_OFFSET, MAX_READOUT, PinholeCamera
from v3d_torch.geometry.distortion import COEFFICIENTS

DISTORTION = frozenset(name for names in COEFFICIENTS.values() for name in names)
"""Names of the distortion coefficients of all models."""

DERIVATIVE_STEPS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy"), 0.1),
    **dict.fromkeys(DISTORTION, 1e-3),
    "inverse_depth_offset": 1e-4,
    "readout": 1e-3,
}
"""Steps of the central differences of residuals by each parameter, in pixels, no unit, 1/m and seconds: large enough
that the tolerance of undistortion, 1e-6 pixels, is negligible, and small enough that the residuals are linear."""


_MIN_FOCAL_LENGTH = 10.0
"""Minimum focal length, at which a step ends, pixels."""

_MAX_OFFSET = MAX_INVERSE_DEPTH_OFFSET - 2 * DERIVATIVE_STEPS["inverse_depth_offset"]
"""Maximum inverse-depth offset, at which a step ends, 1/m; a camera also accepts the values of the central differences
around it."""

LIMITS = {
    "readout": (-MAX_READOUT, MAX_READOUT),
    "inverse_depth_offset": (-_MAX_OFFSET, _MAX_OFFSET),
    "fx": (_MIN_FOCAL_LENGTH, math.inf),
    "fy": (_MIN_FOCAL_LENGTH, math.inf),
}
"""Range of the parameters that have one; a step ends at its limits."""


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that are meaningful only together.

    Attributes:
        name: Name for tables.
        parameters: Names of the parameters.
        tolerance: Maximum accepted standard deviation, in the unit of the parameters; None for parameters whose
            tolerance is `PIXEL_TOLERANCE`.
    """

    name: str
    parameters: tuple[str, ...]
    tolerance: float | None = None


PIXEL_TOLERANCE = 0.005
"""Maximum accepted uncertainty of the pixels of an image that a group of parameters causes: root mean square of the
standard deviations, relative to the width of the image. It is 3 pixels of 640, the accuracy of a manual calibration."""

GROUPS = (
    ParameterGroup("focal length", ("fx", "fy")),
    ParameterGroup("readout", ("readout",), tolerance=0.002),
    ParameterGroup("principal point", ("cx", "cy")),
    ParameterGroup("radial distortion", ("k1", "k2", "k3", "k4", "k5", "k6")),
    ParameterGroup("inverse-depth offset", ("inverse_depth_offset",), tolerance=0.005),
    ParameterGroup("tangential distortion", ("p1", "p2")),
)
"""Groups in the order in which they are freed: by their effect on the images, and a group before groups with a similar
effect. Tangential distortion, for example, has nearly the same effect as a shift of the principal point. The tolerances
correspond to 2 pixels at the upper and lower border of an image that moves by 2000 pixels per second, and to 2 cm at a
depth of 2 m."""


def groups_of(camera: PinholeCamera) -> list[ParameterGroup]:
    """Return the groups, reduced to the parameters of a camera: its model has only some of the coefficients."""
    absent = DISTORTION - set(COEFFICIENTS[camera.distortion_model])
    kept = [
        replace(group, parameters=tuple(each for each in group.parameters if each not in absent)) for group in GROUPS
    ]
    return [group for group in kept if group.parameters]


def get_values(camera: PinholeCamera, readout: float, names: Iterable[str]) -> list[float]:
    """Return parameters of a camera by name.

    Args:
        camera: Camera.
        readout: Readout to return, seconds, because that of the camera can be unknown.
        names: Names of parameters.
    """
    values = vars(camera) | _coefficients(camera) | {"readout": readout}
    return [float(values[name]) for name in names]


def with_values(camera: PinholeCamera, values: Mapping[str, float]) -> PinholeCamera:
    """Return a camera with other values of some parameters.

    Args:
        camera: Camera.
        values: New values by name.
    """
    fields: dict[str, Any] = {name: value for name, value in values.items() if name not in DISTORTION}
    fields["distortion"] = tuple(values.get(name, coefficient) for name, coefficient in _coefficients(camera).items())
    return replace(camera, **fields)


def _coefficients(camera: PinholeCamera) -> dict[str, float]:
    """Distortion coefficients by name, in their order."""
    return dict(zip(COEFFICIENTS[camera.distortion_model], camera.distortion, strict=True))
