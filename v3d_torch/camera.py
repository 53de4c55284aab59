"""The pinhole camera: intrinsics, lens distortion, rays of pixels, back-projection (paper, Sec. III-B.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.depth import depth_to_3d_v2
from torch import Tensor


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an RGB-D camera whose depth is registered to its colour image.

    Args:
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels; pixel centres lie at integers.
        width, height: image size, pixels.
        distortion: k1, k2, p1, p2, k3 of the Brown model in OpenCV's order.
        depth_scale: units of the depth image per metre (TUM: 5000).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 640
    height: int = 480
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float = 5000.0

    @cached_property
    def K(self) -> Tensor:
        """Camera matrix, float64, shape :math:`(3, 3)`."""
        return torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    @property
    def is_distorted(self) -> bool:
        """Whether the lens bends rays at all."""
        return any(self.distortion)

    def undistort(self, uv: Tensor) -> Tensor:
        """Pixels of the image as delivered to pixels of an ideal pinhole camera with the same ``K``.

        Args:
            uv: shape :math:`(N, 2)`, floating point.

        Returns:
            Shape :math:`(N, 2)`, float64.
        """
        # 20 fixed-point steps: with the strong lens of TUM's fr1 the corners need more than kornia's default of 5.
        return self._bend(uv, partial(undistort_points, num_iters=20))

    def distort(self, uv: Tensor) -> Tensor:
        """Pixels of an ideal pinhole camera to pixels of the image as delivered: the inverse of `undistort`.

        Args:
            uv: shape :math:`(N, 2)`, floating point.

        Returns:
            Shape :math:`(N, 2)`, float64.
        """
        return self._bend(uv, distort_points)

    def _bend(self, uv: Tensor, lens: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Tensor:
        uv = uv.to(torch.float64)
        if not self.is_distorted or uv.shape[0] == 0:
            return uv
        coefficients = torch.tensor(self.distortion, dtype=torch.float64)
        return lens(uv[None], self.K[None], coefficients[None])[0]

    def project(self, points: Tensor) -> Tensor:
        """Points in the camera frame to undistorted pixels.

        Args:
            points: metres, shape :math:`(..., 3)`; z must not be 0.

        Returns:
            (u, v), shape :math:`(..., 2)`.
        """
        u = self.fx * points[..., 0] / points[..., 2] + self.cx
        v = self.fy * points[..., 1] / points[..., 2] + self.cy
        return torch.stack([u, v], dim=-1)

    def lift(self, uv: Tensor, depth: Tensor) -> Tensor:
        """Undistorted pixels with their depth to points in the camera frame.

        Args:
            uv: shape :math:`(..., 2)`.
            depth: metres along z, shape :math:`(...)`.

        Returns:
            Shape :math:`(..., 3)`, metres.
        """
        x = (uv[..., 0] - self.cx) / self.fx
        y = (uv[..., 1] - self.cy) / self.fy
        return torch.stack([x * depth, y * depth, depth], dim=-1)

    @cached_property
    def rays(self) -> Tensor:
        """Direction through every pixel at unit depth, undistorted, float32, shape :math:`(H, W, 3)`."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=torch.float64),
            torch.arange(self.width, dtype=torch.float64),
            indexing="ij",
        )
        pixels = self.undistort(torch.stack([u, v], dim=-1).reshape(-1, 2))
        ones = torch.ones(pixels.shape[0], dtype=torch.float64)
        return self.lift(pixels, ones).reshape(self.height, self.width, 3).to(torch.float32)


class BackProjector(torch.nn.Module):
    r"""Depth image to a point per pixel: :math:`x = (u - c_x) z / f_x,\; y = (v - c_y) z / f_y` (paper, Sec. III-B.1).

    Args:
        camera: gives the ray of each pixel, lens distortion included.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__()
        self._camera = camera

    def forward(self, depth: Tensor) -> Tensor:
        """Back-project; differentiable in ``depth``.

        Args:
            depth: metres, float32 or float64, shape :math:`(B, 1, H, W)`.

        Returns:
            Points in the camera frame, metres, shape :math:`(B, H, W, 3)`; (0, 0, 0) where there is no depth.
        """
        rays = self._camera.rays.to(depth.dtype).expand(depth.shape[0], -1, -1, -1)
        return depth_to_3d_v2(depth[:, 0], self._camera.K.to(depth.dtype), xyz_grid=rays)
