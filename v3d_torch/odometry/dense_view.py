"""A frame prepared for dense alignment: images of brightness and inverse depth in several sizes, and points to look up.

Images stay as delivered: points of the reference are bent by the lens on their way into the current view, and the
gradients are unbent in the reference.
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


@dataclass(frozen=True)
class Lens:
    """The camera of a level.

    Attributes:
        camera: intrinsics at the level's size.
        unbend: a gradient (row) by pixels as delivered, times this, is one by undistorted pixels, float32, shape
            :math:`(H, W, 2, 2)`.
    """

    camera: PinholeCamera
    unbend: Tensor

    @staticmethod
    def of(camera: PinholeCamera, halvings: int) -> Lens:
        """The lens of an image that was halved so often."""
        size = 2**halvings
        camera = replace(
            camera,
            fx=camera.fx / size,
            fy=camera.fy / size,
            cx=(camera.cx + 0.5) / size - 0.5,  # pixel centres lie at integers, the image's corner at -0.5
            cy=(camera.cy + 0.5) / size - 0.5,
            width=camera.width // size,
            height=camera.height // size,
        )
        by_row, by_column = torch.gradient(camera.project(camera.rays.to(torch.float64)), dim=(0, 1))
        return Lens(camera, torch.linalg.inv(torch.stack([by_column, by_row], dim=-1)).to(torch.float32))


@dataclass(frozen=True)
class Anchors:
    """Points of a reference on one level.

    Attributes:
        points: in the reference's camera, metres, float32, shape :math:`(M, 3)`.
        values: brightness and inverse depth there, float32, shape :math:`(2, M)`.
        flow: of their pixels as delivered by ``xi`` in ``T_ba @ exp(xi)``, float32, shape :math:`(M, 2, 6)`.
        slopes: of the residuals of both by ``xi``, float64, shape :math:`(2, M, 6)`.
        usable: whether the slope is known, bool, shape :math:`(2, M)`.
    """

    points: Tensor
    values: Tensor
    flow: Tensor
    slopes: Tensor
    usable: Tensor


@dataclass(frozen=True)
class Level:
    """A view at one size.

    Attributes:
        channels: brightness and inverse depth (1/m), float32, shape :math:`(2, H, W)`; not a number where a pixel
            moves or is not measured, so that nothing interpolated from it is a number either.
        lens: of this size.
        config: number of points, edges of depth.
    """

    channels: Tensor
    lens: Lens
    config: DenseOdometryConfig

    @cached_property
    def anchors(self) -> Anchors:
        """The pixel of strongest gradient of every cell, where there is depth.

        Around the solution the current view shows what the reference shows, so that the slopes are the reference's own
        and are not computed again in each step (inverse composition; Baker and Matthews, IJCV 2004).
        """
        gradient = spatial_gradient(self.channels[None])[0]  # Sobel; 2 x (x, y) x H x W
        inverse = self.channels[1]
        same_surface = (2 * gradient[1].abs() <= self.config.edge_ratio * inverse).all(dim=0)
        strength = gradient[0].square().sum(dim=0).where(inverse.isfinite(), torch.nan).nan_to_num(nan=-1.0)
        cell = max(1, round((inverse.numel() / self.config.max_points) ** 0.5))
        strongest, index = max_pool2d(strength[None], cell, ceil_mode=True, return_indices=True)
        index = index[strongest >= 0]

        values = self.channels.flatten(1)[:, index]
        points = self.lens.camera.rays.flatten(0, 1)[index] / values[1, :, None]
        one = torch.ones_like(values[1])
        unit = Measurements(uv=one[:, None].expand(-1, 2), inverse_depth=one, pixel_sigma=one, inverse_depth_sigma=1.0)
        moved = reprojection_jacobian(points, unit, self.lens.camera)  # how (u, v, 1/z) move, M x 3 x 6
        flow = self.lens.unbend.flatten(0, 1)[index] @ moved[:, :2]
        slopes = (gradient.flatten(2)[:, :, index].permute(2, 0, 1) @ flow).transpose(0, 1)
        slopes[1] -= moved[:, 2]  # of a point that comes nearer more inverse depth is expected
        usable = torch.stack([slopes[0].isfinite().all(dim=-1), same_surface.flatten()[index]])
        return Anchors(points, values, flow, slopes.where(usable[..., None], 0.0).to(torch.float64), usable)


class DenseView:
    """A frame prepared for alignment: once, however many others it is aligned with.

    Args:
        grey: brightness from 0 to 1, float32, shape :math:`(1, H, W)`, as delivered (distorted).
        depth: metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        static: pixels that stand still, bool, shape :math:`(H, W)`.
        lenses: by the number of halvings of each level.
        config: range and edges of depth, number of points.
    """

    def __init__(
        self, grey: Tensor, depth: Tensor, static: Tensor, lenses: dict[int, Lens], config: DenseOdometryConfig
    ) -> None:
        static = static[None] & grey.isfinite()
        inverse = torch.where(static & (depth > 0) & (depth <= config.max_depth), 1 / depth, 0.0)
        grey = grey.where(static, 0.0)
        self.levels: dict[int, Level] = {}
        for halvings in range(max(lenses) + 1):
            if halvings:
                grey, static = avg_pool2d(grey, 2), avg_pool2d(static.to(torch.float32), 2) == 1
                inverse = _halve(inverse, config.edge_ratio)
            if halvings in lenses:
                channels = torch.cat([grey.where(static, torch.nan), inverse.where(static & (inverse > 0), torch.nan)])
                self.levels[halvings] = Level(channels, lenses[halvings], config)


def _halve(inverse: Tensor, edge: float) -> Tensor:
    """Inverse depth at half the size: the mean on the nearest surface among four pixels, 0 where none is measured."""
    height, width = inverse.shape[-2:]
    four = pixel_unshuffle(inverse[:, : height // 2 * 2, : width // 2 * 2], 2)
    near = four > (1 - edge) * four.amax(dim=0, keepdim=True)
    return (four * near).sum(dim=0, keepdim=True) / near.sum(dim=0, keepdim=True).clamp(min=1)
