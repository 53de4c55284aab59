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
from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.config import TrackingConfig
from v3d_torch.geometry.argument_checks import check_positive, check_shape
from v3d_torch.kernels import whitening as kernels
from v3d_torch.kernels.compiler import compiled_by
from v3d_torch.runtime.batches import check_sigma, common_batch, fill_padding, to_rows

CHI2_THRESHOLD_2D = 5.991
"""95 % quantile of the chi-square distribution with 2 degrees of freedom: inlier threshold for (u, v)."""

CHI2_THRESHOLD_3D = 7.815
"""95 % quantile of the chi-square distribution with 3 degrees of freedom: inlier threshold for (u, v, 1/z)."""

MIN_DEPTH = 0.05
"""Smallest depth of a projected point, metres, below the range of any RGB-D camera. Keeps 1/z finite for points that an
optimisation step moves behind the camera."""


INVERSE_DEPTH_SIGMA = TrackingConfig().inverse_depth_sigma
"""Default standard deviation of inverse depth, 1/m: the default of ``tracking.inverse_depth_sigma``."""


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Measured pixels and inverse depths of landmarks.

    Attributes:
        uv: Undistorted pixels, shape :math:`(..., M, 2)`.
        inverse_depth: Inverse of the measured depth along z, 1/m, shape :math:`(..., M)`; 0 = not measured.
        pixel_sigma: Standard deviation of u and of v, pixels, a number or shape :math:`(..., M)`.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m, a number or shape :math:`(..., M)`. It is nearly
            constant, as the noise of disparity of stereo and structured-light cameras is; the standard deviation of
            depth is z^2 times as large (Khoshelham and Elberink, Sensors 2012).
    """

    uv: Tensor
    inverse_depth: Tensor
    pixel_sigma: Tensor | float
    inverse_depth_sigma: Tensor | float

    @property
    def chi2_threshold(self) -> Tensor:
        """Chi-square threshold of an inlier (95 % quantile) for each measurement, shape :math:`(..., M)`."""
        threshold = torch.full_like(self.inverse_depth, CHI2_THRESHOLD_2D)
        return threshold.masked_fill(self.inverse_depth > 0, CHI2_THRESHOLD_3D)


def prepare_measurements(
    uv: Tensor,
    inverse_depth: Tensor | None,
    pixel_sigma: Tensor | float,
    inverse_depth_sigma: Tensor | float,
    valid: Tensor,
) -> Measurements:
    """Convert measurements to float64, and replace the padding, so that it causes neither NaN nor gradients.

    Args:
        uv: Undistorted pixels, shape :math:`(..., M, 2)`.
        inverse_depth: Inverse of the measured depth, 1/m, shape :math:`(..., M)`; 0, NaN or infinite = not measured.
            None if no depth was measured.
        pixel_sigma: Standard deviation of u and of v, pixels, a number or shape :math:`(..., M)`.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m, a number or shape :math:`(..., M)`.
        valid: Mask of the measurements that are not padding, bool, shape :math:`(..., M)`.

    Raises:
        ConfigError: If a standard deviation that is a number is not positive.
        InputError: If the standard deviation of a measurement in a tensor is not positive.
    """
    check_positive(pixel_sigma=pixel_sigma, inverse_depth_sigma=inverse_depth_sigma)
    for name, sigma in (("pixel_sigma", pixel_sigma), ("inverse_depth_sigma", inverse_depth_sigma)):
        if not isinstance(sigma, Tensor):
            continue
        # The shape (M, 1) would broadcast to M problems of a batch, each with one standard deviation.
        if sigma.numel() != 1:
            check_shape(name, sigma, "*", uv.shape[-2])
        check_sigma(name, sigma, valid)
    if inverse_depth is None:
        inverse_depth = torch.zeros_like(uv[..., 0])
    inverse_depth = fill_padding(inverse_depth, valid, 0.0)
    is_measured = (inverse_depth > 0) & (inverse_depth < torch.inf)
    return Measurements(
        uv=fill_padding(uv, valid[..., None], 0.0),
        inverse_depth=torch.where(is_measured, inverse_depth, 0.0),
        pixel_sigma=fill_padding(pixel_sigma, valid, 1.0) if isinstance(pixel_sigma, Tensor) else pixel_sigma,
        inverse_depth_sigma=fill_padding(inverse_depth_sigma, valid, 1.0)
        if isinstance(inverse_depth_sigma, Tensor)
        else inverse_depth_sigma,
    )


class WhitenedMeasurements(NamedTuple):
    """Measurements in whitened form: residual = ``scale * (x/z, y/z, 1/z) + offset``.

    Attributes:
        scale: Focal lengths, and 1 for 1/z, divided by the standard deviations, shape :math:`(..., 3, M)`; 0 for depth
            that was not measured.
        offset: Principal point (0 for 1/z) minus measurement, divided by the standard deviations, shape
            :math:`(..., 3, M)`.
    """

    scale: Tensor
    offset: Tensor

    def residuals(self, projected: Tensor) -> Tensor:
        """Whitened residuals, shape :math:`(..., 3, M)`, of points projected by `perspective`, of the same shape."""
        return torch.addcmul(self.offset, self.scale, projected)


def _whiten_compiled(measured: Measurements, K: Tensor) -> WhitenedMeasurements:
    uv, inverse_depth = measured.uv, measured.inverse_depth
    sigmas = (
        sigma if isinstance(sigma, Tensor) else torch.full_like(inverse_depth, sigma)
        for sigma in (measured.pixel_sigma, measured.inverse_depth_sigma)
    )
    columns = (inverse_depth, *sigmas)
    if any(each.requires_grad or each.dtype != torch.float64 for each in (uv, *columns, K)):
        return NotImplemented
    pixel_sigma, inverse_depth_sigma = columns[1:]
    batch = common_batch(
        uv=(uv, 2),
        K=(K, 2),
        inverse_depth=(inverse_depth, 1),
        pixel_sigma=(pixel_sigma, 1),
        inverse_depth_sigma=(inverse_depth_sigma, 1),
    )
    given = (
        uv.expand(*batch, *uv.shape[-2:]),
        *(each.expand(*batch, uv.shape[-2]) for each in columns),
        K.expand(*batch, 3, 3),
    )
    parts = kernels.whiten(*(to_rows(each, batch) for each in given))
    return WhitenedMeasurements(*(torch.from_numpy(each).reshape(*batch, *each.shape[1:]) for each in parts))


@compiled_by(_whiten_compiled)
def whiten(measured: Measurements, K: Tensor) -> WhitenedMeasurements:
    """Precompute the parts of the residuals that do not depend on the pose.

    Args:
        measured: Measured pixels and inverse depths.
        K: Camera matrix, shape :math:`(..., 3, 3)`.
    """
    u, v = measured.uv.unbind(-1)
    fx, fy, cx, cy = (K[..., row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    has_depth, sigma = measured.inverse_depth > 0, measured.pixel_sigma
    inverse_depth = torch.where(has_depth, measured.inverse_depth, 0)
    scale = fx * (1 / sigma), fy * (1 / sigma), has_depth.to(u.dtype) / measured.inverse_depth_sigma
    offset = (cx - u) / sigma, (cy - v) / sigma, inverse_depth / -measured.inverse_depth_sigma
    parts = torch.broadcast_tensors(*scale, *offset)
    return WhitenedMeasurements(torch.stack(parts[:3], dim=-2), torch.stack(parts[3:], dim=-2))


def perspective(points: Tensor) -> Tensor:
    """Normalised image coordinates and inverse depth (x/z, y/z, 1/z) of points.

    Args:
        points: Points in the camera frame, metres, shape :math:`(..., 3, M)`.

    Returns:
        Shape :math:`(..., 3, M)`.
    """
    w = 1 / points[..., 2:, :].clamp(min=MIN_DEPTH)
    return torch.cat([points[..., :2, :] * w, w], dim=-2)


def perspective_jacobian(projected: Tensor) -> Tensor:
    """Derivatives of `perspective` with respect to the left perturbation of ``T_cw``.

    Args:
        projected: Points projected by `perspective`, shape :math:`(..., 3, M)`.

    Returns:
        Derivatives with respect to translation, then rotation, shape :math:`(..., 6, 3, M)`; the first three equal
        those with respect to the point.
    """
    a, b, w = projected.unbind(dim=-2)  # (x/z, y/z, 1/z)
    o = torch.zeros_like(w)
    rows = (
        w, o, o,
        o, w, o,
        -w * a, -w * b, -w * w,
        -b * a, -b * b - 1, -b * w,
        a * a + 1, a * b, a * w,
        -b, a, o,
    )  # fmt: skip
    return torch.stack(rows, dim=-2).unflatten(-2, (6, 3))


def reprojection_residuals(points: Tensor, measured: Measurements, K: Tensor) -> Tensor:
    """Whitened reprojection residuals of (u, v, 1/z).

    Args:
        points: Landmark of each measurement in the camera frame, metres, shape :math:`(..., M, 3)`.
        measured: Measured pixels and inverse depths.
        K: Camera matrix, shape :math:`(..., 3, 3)`.

    Returns:
        Residuals in standard deviations, shape :math:`(..., M, 3)`; the third is 0 if depth was not measured. The
        tensor is a transposed view, with the measurements contiguous in memory.
    """
    return whiten(measured, K).residuals(perspective(points.mT)).mT


def reprojection_jacobian(points: Tensor, measured: Measurements, K: Tensor) -> Tensor:
    """Jacobian of the whitened reprojection residuals with respect to the left perturbation of ``T_cw``.

    Args:
        points: Landmark of each measurement in the camera frame, metres, shape :math:`(..., M, 3)`.
        measured: Measured pixels and inverse depths.
        K: Camera matrix, shape :math:`(..., 3, 3)`.

    Returns:
        Jacobian, shape :math:`(..., M, 3, 6)`; the first three columns are also that with respect to ``points``.
        The tensor is a transposed view, with the measurements contiguous in memory.
    """
    scale = whiten(measured, K).scale
    return (perspective_jacobian(perspective(points.mT)) * scale[..., None, :, :]).movedim(-1, -3).mT


def chi_square(points: Tensor, residuals: Tensor) -> Tensor:
    """Squared whitened residuals; infinite for points that are not in front of the camera.

    Args:
        points: Landmark of each measurement in the camera frame, metres, shape :math:`(..., M, 3)`.
        residuals: Whitened residuals, shape :math:`(..., M, 3)`.

    Returns:
        Shape :math:`(..., M)`.
    """
    return torch.where(points[..., 2] > MIN_DEPTH, (residuals * residuals).sum(dim=-1), torch.inf)
