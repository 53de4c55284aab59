"""Image pyramid of a frame for dense alignment, and the reference points of each level.

Images keep their lens distortion: reference points are distorted when they are projected into the current view, and the
gradients of the reference are converted to undistorted pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from kornia.filters import spatial_gradient
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, pixel_unshuffle

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.optim.reprojection import Measurements, reprojection_jacobian

_MAX_POINTS = 5000
"""Approximate number of reference points of a level, one per grid cell: more points take more time and add little."""


@dataclass(frozen=True)
class LevelCamera:
    """Camera model of one pyramid level.

    Attributes:
        camera: Intrinsics at the size of the level.
        distortion_jacobian: Derivative of distorted with respect to undistorted pixels at every pixel, float32, shape
            :math:`(H, W, 2, 2)`: a gradient by distorted pixels (row vector) times this matrix is the gradient by
            undistorted pixels.
    """

    camera: PinholeCamera
    distortion_jacobian: Tensor

    @staticmethod
    def from_camera(camera: PinholeCamera, halvings: int) -> LevelCamera:
        """Camera model of a pyramid level.

        Args:
            camera: Intrinsics at full resolution.
            halvings: Number of times that the image was halved.
        """
        factor = 2**halvings
        camera = replace(
            camera,
            fx=camera.fx / factor,
            fy=camera.fy / factor,
            cx=(camera.cx + 0.5) / factor - 0.5,  # pixel centres lie at integers, the image's corner at -0.5
            cy=(camera.cy + 0.5) / factor - 0.5,
            width=camera.width // factor,
            height=camera.height // factor,
        )
        by_row, by_column = torch.gradient(camera.project(camera.rays.to(torch.float64)), dim=(0, 1))
        undistortion_jacobian = torch.stack([by_column, by_row], dim=-1)
        return LevelCamera(camera, torch.linalg.inv(undistortion_jacobian).to(torch.float32))


@dataclass(frozen=True)
class ReferencePoints:
    """Points of a reference view on one pyramid level, and Jacobians with respect to ``xi`` in ``T_ba @ exp(xi)``.

    Attributes:
        points: Points in the camera frame of the reference, metres, float32, shape :math:`(M, 3)`.
        values: Brightness and inverse depth (1/m), float32, shape :math:`(2, M)`.
        pixel_jacobian: Derivatives of the distorted pixels, float32, shape :math:`(M, 2, 6)`.
        jacobian: Derivatives of the brightness and inverse-depth residuals, float64, shape :math:`(2, M, 6)`.
        usable: Mask of the derivatives that are known, bool, shape :math:`(2, M)`.
    """

    points: Tensor
    values: Tensor
    pixel_jacobian: Tensor
    jacobian: Tensor
    usable: Tensor


@dataclass(frozen=True)
class Level:
    """One pyramid level of a view.

    Attributes:
        channels: Brightness and inverse depth (1/m), float32, shape :math:`(2, H, W)`. NaN for pixels that are not
            static or not measured, so that every interpolation that uses them is NaN, too.
        level_camera: Camera model of this level.
        config: Threshold of depth edges.
    """

    channels: Tensor
    level_camera: LevelCamera
    config: DenseOdometryConfig

    @cached_property
    def reference_points(self) -> ReferencePoints:
        """Pixel with the strongest brightness gradient of each grid cell, among the pixels with depth.

        Near the solution the current view is similar to the reference, so the Jacobians are computed once from the
        gradients of the reference and not in every step (inverse composition; Baker and Matthews, IJCV 2004).
        """
        gradient = spatial_gradient(self.channels[None])[0]  # Sobel; 2 x (x, y) x H x W
        inverse_depth = self.channels[1]
        same_surface = (2 * gradient[1].abs() <= self.config.edge_ratio * inverse_depth).all(dim=0)
        strength = gradient[0].square().sum(dim=0).where(inverse_depth.isfinite(), torch.nan).nan_to_num(nan=-1.0)
        cell = max(1, round((inverse_depth.numel() / _MAX_POINTS) ** 0.5))
        strongest, index = max_pool2d(strength[None], cell, ceil_mode=True, return_indices=True)
        index = index[strongest >= 0]

        values = self.channels.flatten(1)[:, index]
        points = self.level_camera.camera.rays.flatten(0, 1).to(index.device)[index] / values[1, :, None]
        one = torch.ones_like(values[1])
        unit = Measurements(uv=one[:, None].expand(-1, 2), inverse_depth=one, pixel_sigma=one, inverse_depth_sigma=1.0)
        # Derivatives of (u, v, 1/z), M x 3 x 6.
        point_jacobian = reprojection_jacobian(points, unit, self.level_camera.camera.K.to(points))
        pixel_jacobian = (
            self.level_camera.distortion_jacobian.flatten(0, 1).to(index.device)[index] @ point_jacobian[:, :2]
        )
        jacobian = (gradient.flatten(2)[:, :, index].permute(2, 0, 1) @ pixel_jacobian).transpose(0, 1)
        jacobian[1] -= point_jacobian[:, 2]  # the expected inverse depth changes with the point, too
        usable = torch.stack([jacobian[0].isfinite().all(dim=-1), same_surface.flatten()[index]])
        jacobian = jacobian.where(usable[..., None], 0.0).to(torch.float64)
        return ReferencePoints(points, values, pixel_jacobian, jacobian, usable)


class DenseView:
    """A frame prepared for dense alignment with any number of other frames.

    Args:
        grey: Brightness from 0 to 1, float32, shape :math:`(1, H, W)`, distorted.
        depth: Depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        static: Mask of the static pixels, bool, shape :math:`(H, W)`.
        cameras: Camera model of each pyramid level, by its number of halvings.
        config: Maximum depth, threshold of depth edges.
    """

    def __init__(
        self, grey: Tensor, depth: Tensor, static: Tensor, cameras: dict[int, LevelCamera], config: DenseOdometryConfig
    ) -> None:
        static = static[None] & grey.isfinite()
        inverse_depth = torch.where(static & (depth > 0) & (depth <= config.max_depth), 1 / depth, 0.0)
        grey = grey.where(static, 0.0)
        self.levels: dict[int, Level] = {}
        for halvings in range(max(cameras) + 1):
            if halvings:
                grey, static = avg_pool2d(grey, 2), avg_pool2d(static.to(torch.float32), 2) == 1
                inverse_depth = _halve(inverse_depth, config.edge_ratio)
            if halvings in cameras:
                channels = torch.cat(
                    [grey.where(static, torch.nan), inverse_depth.where(static & (inverse_depth > 0), torch.nan)]
                )
                self.levels[halvings] = Level(channels, cameras[halvings], config)


def _halve(inverse_depth: Tensor, edge_ratio: float) -> Tensor:
    """Inverse depth at half the resolution: mean over the nearest surface in each block of four pixels, or 0."""
    height, width = inverse_depth.shape[-2:]
    four = pixel_unshuffle(inverse_depth[:, : height // 2 * 2, : width // 2 * 2], 2)
    near = four > (1 - edge_ratio) * four.amax(dim=0, keepdim=True)
    return (four * near).sum(dim=0, keepdim=True) / near.sum(dim=0, keepdim=True).clamp(min=1)
