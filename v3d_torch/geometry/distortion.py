"""Lens distortion models, with their names in ROS.

``plumb_bob`` is the Brown-Conrady model (OpenCV's default), ``rational_polynomial`` its extension by a denominator, and
``equidistant`` the fisheye model of Kannala and Brandt (PAMI 2006), as in OpenCV's module ``fisheye``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, cast, get_args

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.config.validation import to_float
from v3d_torch.errors import InputError
from v3d_torch.kernels.camera import MIN_RADIUS

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
"""Name of a distortion model."""

COEFFICIENTS: Mapping[DistortionModel, tuple[str, ...]] = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
"""Names of the coefficients of each model, in OpenCV's order."""

# The corners of an image with strong lens distortion take about 20 steps. The tolerance is in pixels.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)

_FISHEYE_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
"""The tolerance is in radians."""


def complete_distortion(given: object, model: str) -> tuple[tuple[float, ...], DistortionModel]:
    """Check distortion coefficients, and append the zeros that are missing.

    Args:
        given: Coefficients: numbers, or an array of any shape as OpenCV returns it.
        model: Name of the model. As in OpenCV, the number of coefficients distinguishes the two polynomial models.

    Returns:
        All coefficients of the model, and the name of the model: ``plumb_bob`` if the coefficients that only
        ``rational_polynomial`` has are 0.

    Raises:
        InputError: If the model is unknown, a coefficient is not a finite number, or there are too many.
    """
    numbers = [to_float(value) for value in np.ravel(np.asarray(given, dtype=object))]
    if model in ("plumb_bob", "rational_polynomial"):
        model = "rational_polynomial" if any(numbers[len(COEFFICIENTS["plumb_bob"]) :]) else "plumb_bob"
    if model not in get_args(DistortionModel):
        raise InputError(f"the camera's distortion_model is {model!r}; give one of {', '.join(COEFFICIENTS)}")
    known = cast("DistortionModel", model)
    names = COEFFICIENTS[known]
    if not np.isfinite(numbers).all():
        raise InputError(f"the camera's distortion is {given!r}; give the numbers {', '.join(names)}")
    if any(numbers[len(names) :]):
        raise InputError(
            f"the camera's distortion has {len(numbers)} coefficients, the model {known} has {len(names)}; give"
            f" {', '.join(names)}, calibrated without further coefficients"
        )
    return (*numbers[: len(names)], *[0.0] * (len(names) - len(numbers))), known


def distort(xy: Tensor, model: DistortionModel, coefficients: tuple[float, ...]) -> Tensor:
    """Distort normalised image coordinates (x / z, y / z).

    Args:
        xy: Normalised image coordinates, float64, shape :math:`(N, 2)`.
        model: Name of the model.
        coefficients: Coefficients of the model.

    Returns:
        Distorted normalised image coordinates, float64, shape :math:`(N, 2)`. Differentiable.
    """
    r2 = xy.square().sum(dim=1, keepdim=True)
    if model == "equidistant":
        k1, k2, k3, k4 = coefficients
        r = r2.clamp(min=MIN_RADIUS**2).sqrt()
        theta = torch.atan(r)
        t2 = theta.square()
        return xy * (theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r)
    k1, k2, p1, p2, k3, *denominator = coefficients
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if any(denominator):
        k4, k5, k6 = denominator
        radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    tangential = xy.new_tensor([p2, p1])
    return xy * (radial + 2 * (xy @ tangential)[:, None]) + r2 * tangential


def undistort_pixels(uv: Tensor, K: Tensor, model: DistortionModel, coefficients: tuple[float, ...]) -> Tensor:
    """Map distorted to undistorted pixels with OpenCV, which solves the equations iteratively.

    Args:
        uv: Pixels in the recorded image, float64, shape :math:`(N, 2)`, N > 0.
        K: Camera matrix, float64, shape :math:`(3, 3)`.
        model: Name of the model.
        coefficients: Coefficients of the model.

    Returns:
        Pixels of an ideal pinhole camera with the same ``K``, float64, shape :math:`(N, 2)`. For a pixel to which the
        model maps no ray, the result is meaningless.
    """
    matrix, vector = K.numpy(), np.array(coefficients)
    if model == "equidistant":
        points = uv.numpy()[:, None]
        pixels = cv2.fisheye.undistortPoints(points, matrix, vector, None, None, matrix, _FISHEYE_CRITERIA)
    else:
        pixels = cv2.undistortImagePoints(uv.numpy(), matrix, vector, None, _CRITERIA)
    return torch.from_numpy(pixels).view_as(uv)


def kernel_coefficients(model: DistortionModel, coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Return the coefficients in the common layout of all models, see `v3d_torch.kernels.camera.Intrinsics`.

    Args:
        model: Name of the model.
        coefficients: Coefficients of the model.

    Returns:
        ``k1, k2, p1, p2, k3, k4, k5, k6`` and a flag, which is 1 for ``equidistant`` and 0 for other models.
    """
    named = dict(zip(COEFFICIENTS[model], coefficients, strict=True))
    layout = (named.get(name, 0.0) for name in COEFFICIENTS["rational_polynomial"])
    return *layout, float(model == "equidistant")
