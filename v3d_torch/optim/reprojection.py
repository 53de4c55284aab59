r"""Whitened reprojection residuals of pixels and inverse depth, and their Jacobians.

A landmark at :math:`(x, y, z)` in the camera frame has the residual

.. math::
    r = \left( \frac{\hat u - u}{\sigma},\; \frac{\hat v - v}{\sigma},\; \frac{1 / z - w}{\sigma_w} \right)

with the projection :math:`(\hat u, \hat v)`, the measured pixel :math:`(u, v)` and the measured inverse depth
:math:`w`: prediction minus measurement, in standard deviations.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.kernels import whitening as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

CHI2_THRESHOLD_2D = 5.991
"""95 % quantile of the chi-square distribution with 2 degrees of freedom: inlier threshold for (u, v)."""

_CHI2_THRESHOLD_3D = 7.815
"""95 % quantile of the chi-square distribution with 3 degrees of freedom: inlier threshold for (u, v, 1/z)."""

MIN_DEPTH = 0.05
"""Smallest depth of a projected point, metres, below the range of any RGB-D camera. Keeps 1/z finite for points that an
optimisation step moves behind the camera."""


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Measured pixels and inverse depths of landmarks.

    Attributes:
        uv: Undistorted pixels, float64, shape :math:`(M, 2)`.
        inverse_depth: Inverse of the measured depth along z, 1/m, float64, shape :math:`(M,)`; 0 = not measured.
        pixel_sigma: Standard deviation of u and of v, pixels, shape :math:`(M,)`.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m. It is constant, like the disparity noise of any
            stereo or structured-light camera; the depth noise is this times z^2 (Khoshelham and Elberink, Sensors
            2012).
    """

    uv: Tensor
    inverse_depth: Tensor
    pixel_sigma: Tensor
    inverse_depth_sigma: float

    @property
    def chi2_threshold(self) -> Tensor:
        """Chi-square threshold of an inlier, at 95 %, for each measurement, shape :math:`(M,)`."""
        thresholds = torch.full_like(self.inverse_depth, CHI2_THRESHOLD_2D)
        return thresholds.masked_fill_(self.inverse_depth > 0, _CHI2_THRESHOLD_3D)


@dataclass(frozen=True)
class WhitenedMeasurements:
    """Measurements in whitened form: residual = ``scale * (x/z, y/z, 1/z) + offset``.

    Attributes:
        scale: Focal lengths, and 1 for 1/z, divided by the standard deviations, float64, shape :math:`(3, M)`; 0 for
            depth that was not measured.
        offset: Principal point (0 for 1/z) minus measurement, divided by the standard deviations, float64, shape
            :math:`(3, M)`.
    """

    scale: Tensor
    offset: Tensor

    def residuals(self, projected: Tensor) -> Tensor:
        """Whitened residuals of points given by `perspective`, both of shape :math:`(3, M)`."""
        return torch.addcmul(self.offset, self.scale, projected)


def _whiten_compiled(measured: Measurements, camera: PinholeCamera) -> WhitenedMeasurements:
    columns = measured.uv, measured.inverse_depth, measured.pixel_sigma
    if any(column.dtype != torch.float64 or column.requires_grad for column in columns) or measured.uv.ndim != 2:
        return NotImplemented
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    uv, inverse_depth, pixel_sigma = map(to_array, columns)
    whitened = kernels.whiten(uv, inverse_depth, pixel_sigma, measured.inverse_depth_sigma, intrinsics)
    return WhitenedMeasurements(*map(torch.from_numpy, whitened))


@compiled_by(_whiten_compiled)
def whiten(measured: Measurements, camera: PinholeCamera) -> WhitenedMeasurements:
    """Precompute the parts of the residuals that do not depend on the pose.

    Args:
        measured: Measured pixels and inverse depths.
        camera: Intrinsics.
    """
    u, v = measured.uv.unbind(-1)
    has_depth, sigma = measured.inverse_depth > 0, measured.pixel_sigma
    inverse_depth = torch.where(has_depth, measured.inverse_depth, 0)
    return WhitenedMeasurements(
        scale=torch.stack([camera.fx / sigma, camera.fy / sigma, has_depth.to(u.dtype) / measured.inverse_depth_sigma]),
        offset=torch.stack(
            [(camera.cx - u) / sigma, (camera.cy - v) / sigma, inverse_depth / -measured.inverse_depth_sigma]
        ),
    )


def perspective(points: Tensor) -> Tensor:
    """Normalised image coordinates and inverse depth (x/z, y/z, 1/z) of points.

    Args:
        points: Points in the camera frame, metres, shape :math:`(3, M)`.

    Returns:
        Shape :math:`(3, M)`.
    """
    w = 1 / points[2:].clamp(min=MIN_DEPTH)
    return torch.cat([points[:2] * w, w])


# With (a, b, w) = (x/z, y/z, 1/z), the derivatives of (a, b, w) by the six components of xi are
#   (w, 0, 0), (0, w, 0), -w (a, b, w), -b (a, b, w) - (0, 1, 0), a (a, b, w) + (1, 0, 0), (-b, a, 0):
# a constant part, a part linear in (a, b, w), and the products of (a, b, w) with (-w, -b, a).
_CONSTANT, _LINEAR = torch.zeros(6, 3, 1, dtype=torch.float64), torch.zeros(6, 3, 3, dtype=torch.float64)
_CONSTANT[3, 1], _CONSTANT[4, 0] = -1.0, 1.0
_LINEAR[0, 0, 2], _LINEAR[1, 1, 2], _LINEAR[5, 0, 1], _LINEAR[5, 1, 0] = 1.0, 1.0, -1.0, 1.0
_CONSTANT, _LINEAR = _CONSTANT.flatten(0, 1), _LINEAR.flatten(0, 1)
_QUADRATIC = torch.tensor([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)


def perspective_jacobian(projected: Tensor) -> Tensor:
    """Derivatives of `perspective` by the left perturbation of ``T_cw``.

    Args:
        projected: Points given by `perspective`, shape :math:`(3, M)`.

    Returns:
        Derivatives by translation, then rotation, shape :math:`(6, 3, M)`.
    """
    constant, linear, quadratic = (part.to(projected.dtype) for part in (_CONSTANT, _LINEAR, _QUADRATIC))
    jacobian = torch.addmm(constant, linear, projected).unflatten(0, (6, 3))
    jacobian[2:5].addcmul_((quadratic @ projected)[:, None], projected)
    return jacobian


def reprojection_residuals(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """Whitened reprojection residuals of (u, v, 1/z).

    Args:
        points: Landmark of each measurement in the camera frame, metres, float64, shape :math:`(M, 3)`.
        measured: Measured pixels and inverse depths.
        camera: Intrinsics.

    Returns:
        Residuals in standard deviations, shape :math:`(M, 3)`; the third is 0 if depth was not measured. A transposed
        view: the measurements are contiguous in memory.
    """
    return whiten(measured, camera).residuals(perspective(points.T)).T


def reprojection_jacobian(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """Jacobian of the whitened reprojection residuals by the left perturbation of ``T_cw``.

    Args:
        points: Landmark of each measurement in the camera frame, metres, float64, shape :math:`(M, 3)`.
        measured: Measured pixels and inverse depths.
        camera: Intrinsics.

    Returns:
        Shape :math:`(M, 3, 6)`; the first three columns are the Jacobian by ``points``, too. A transposed view: the
        measurements are contiguous in memory.
    """
    scale = whiten(measured, camera).scale
    return (perspective_jacobian(perspective(points.T)) * scale).permute(2, 1, 0)


def chi_square(points: Tensor, residuals: Tensor) -> Tensor:
    """Squared whitened residuals; infinite for points that are not in front of the camera.

    Args:
        points: Landmark of each measurement in the camera frame, metres, shape :math:`(M, 3)`.
        residuals: Whitened residuals, shape :math:`(M, 3)`.

    Returns:
        Shape :math:`(M,)`.
    """
    return torch.where(points[:, 2] > MIN_DEPTH, (residuals * residuals).sum(dim=-1), torch.inf)
