"""Reprojection errors of pixels and inverse depth, in standard deviations, and their Jacobians.

Convention: poses ``T_cw`` are perturbed on the left, ``exp(xi) @ T_cw``, with ``xi = [translation, rotation]``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera

INLIER_LIMIT = 5.991
"""Squared error of (u, v) in sigmas that 95 % of good observations stay below: chi-square with 2 degrees of freedom."""

_LIMIT_WITH_DEPTH = 7.815  # the same for (u, v, 1/z), with 3

_NEAREST = 0.05  # metres: no camera sees nearer; keeps 1/z finite for points that a step puts behind the camera


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Where the camera sees landmarks, and how far away.

    Attributes:
        uv: undistorted pixels, float64, shape :math:`(M, 2)`.
        inverse_depth: of the measured depth along z, 1/m, float64, shape :math:`(M,)`; 0 = not measured.
        pixel_sigma: standard deviation of u and of v, pixels, :math:`(M,)`.
        inverse_depth_sigma: standard deviation of inverse depth, 1/m. Constant, as of the disparity of any stereo or
            structured-light camera: depth itself errs by this times z^2 (Khoshelham and Elberink, Sensors 2012).
    """

    uv: Tensor
    inverse_depth: Tensor
    pixel_sigma: Tensor
    inverse_depth_sigma: float

    @property
    def limit(self) -> Tensor:
        """Squared error in sigmas that 95 % of good observations stay below, :math:`(M,)`."""
        return torch.full_like(self.inverse_depth, INLIER_LIMIT).masked_fill_(self.inverse_depth > 0, _LIMIT_WITH_DEPTH)


@dataclass(frozen=True)
class Whitened:
    """Measurements as the errors count them: in sigmas, error = ``scale * (x/z, y/z, 1/z) + offset``.

    Attributes:
        scale: float64, shape :math:`(3, M)`; 0 where no depth was measured.
        offset: the same, of what was measured.
    """

    scale: Tensor
    offset: Tensor

    def errors(self, seen: Tensor) -> Tensor:
        """Errors of (u, v, 1/z) in sigmas, of points seen at `perspective`, both :math:`(3, M)`."""
        return torch.addcmul(self.offset, self.scale, seen)


def whitened(measured: Measurements, camera: PinholeCamera) -> Whitened:
    """What makes `perspective` errors. All that is the same wherever the camera is, worked out once."""
    u, v = measured.uv.unbind(-1)
    known, sigma = measured.inverse_depth > 0, measured.pixel_sigma
    inverse_depth = torch.where(known, measured.inverse_depth, 0)
    return Whitened(
        scale=torch.stack([camera.fx / sigma, camera.fy / sigma, known.to(u.dtype) / measured.inverse_depth_sigma]),
        offset=torch.stack(
            [(camera.cx - u) / sigma, (camera.cy - v) / sigma, inverse_depth / -measured.inverse_depth_sigma]
        ),
    )


def perspective(points: Tensor) -> Tensor:
    """(x/z, y/z, 1/z) of points in the camera frame, metres, both :math:`(3, M)`."""
    w = 1 / points[2:].clamp(min=_NEAREST)
    return torch.cat([points[:2] * w, w])


def perspective_jacobian(seen: Tensor) -> Tensor:
    """How `perspective` changes when the camera moves, by the left perturbation of ``T_cw``.

    Args:
        seen: where the points are seen, shape :math:`(3, M)`.

    Returns:
        Derivatives by translation and rotation, shape :math:`(6, 3, M)`.
    """
    constant, linear, turn = (numbers.to(seen.dtype) for numbers in (_CONSTANT, _LINEAR, _TURN))
    jacobian = torch.addmm(constant, linear, seen).unflatten(0, (6, 3))
    jacobian[2:5].addcmul_((turn @ seen)[:, None], seen)
    return jacobian


# With (a, b, w) = (x/z, y/z, 1/z) the derivatives by the six perturbations are the rows
#   (w, 0, 0), (0, w, 0), -w (a, b, w), -b (a, b, w) - (0, 1, 0), a (a, b, w) + (1, 0, 0), (-b, a, 0):
# constant, linear in (a, b, w), and the products of that with (-w, -b, a). So they take three operations.
_CONSTANT, _LINEAR = torch.zeros(6, 3, 1, dtype=torch.float64), torch.zeros(6, 3, 3, dtype=torch.float64)
_CONSTANT[3, 1], _CONSTANT[4, 0] = -1.0, 1.0
_LINEAR[0, 0, 2], _LINEAR[1, 1, 2], _LINEAR[5, 0, 1], _LINEAR[5, 1, 0] = 1.0, 1.0, -1.0, 1.0
_CONSTANT, _LINEAR = _CONSTANT.flatten(0, 1), _LINEAR.flatten(0, 1)
_TURN = torch.tensor([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)


def reprojection(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """Errors of (u, v, 1/z) in standard deviations.

    Args:
        points: landmark of each observation in the camera frame, metres, float64, shape :math:`(M, 3)`.
        measured: where they were seen.
        camera: intrinsics.

    Returns:
        Shape :math:`(M, 3)`, the third 0 where no depth was measured. In memory the observations come last.
    """
    return whitened(measured, camera).errors(perspective(points.T)).T


def reprojection_jacobian(points: Tensor, measured: Measurements, camera: PinholeCamera) -> Tensor:
    """How the errors of `reprojection` change when the camera moves.

    Returns:
        By the left perturbation of ``T_cw``, shape :math:`(M, 3, 6)`. Its first three columns are the Jacobian by
        ``points``. In memory the observations come last.
    """
    scale = whitened(measured, camera).scale
    return (perspective_jacobian(perspective(points.T)) * scale).permute(2, 1, 0)


def chi_square(points: Tensor, residuals: Tensor) -> Tensor:
    """Squared error of each observation in sigmas, :math:`(M,)`; infinite for points that are not in front."""
    return torch.where(points[:, 2] > _NEAREST, (residuals * residuals).sum(dim=-1), torch.inf)
