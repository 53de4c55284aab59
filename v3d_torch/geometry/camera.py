"""The pinhole camera: intrinsics, lens distortion, rays of pixels, back-projection (paper, Sec. III-B.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property

import cv2
import numpy as np
import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor

from v3d_torch.config.validation import to_float
from v3d_torch.errors import InputError

MAX_READOUT = 0.05
"""Seconds: no camera takes longer to read the rows of an image."""


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an RGB-D camera whose depth is registered to its colour image.

    Args:
        fx: focal length along u, pixels.
        fy: focal length along v, pixels.
        cx: u of the principal point, pixels; pixel centres lie at integers.
        cy: v of the principal point, pixels.
        width: columns of the images, pixels.
        height: rows of the images, pixels.
        distortion: k1, k2, p1, p2, k3 of the Brown model in OpenCV's order; as it gives them, an array of four or more.
        depth_scale: units of the depth image per metre (TUM: 5000).
        readout: time from the first row of a colour image to the last, seconds, where it is known: 0 of a global
            shutter, as rendered images have, less than 0 where rows are read from below; None where the images tell.

    Raises:
        InputError: one of them is no such number. A focal length below 0, as ICL-NUIM publishes for a y axis that
            points up, is none: that of an image points down.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 640
    height: int = 480
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float = 5000.0
    readout: float | None = None

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "width", "height", "depth_scale"):
            given = getattr(self, name)
            value = to_float(given)
            if not math.isfinite(value) or (value <= 0 and name not in ("cx", "cy")):
                above = "" if name in ("cx", "cy") else " above 0"
                raise InputError(f"the camera's {name} is {given!r}; give a finite number{above}")
            if name in ("width", "height"):
                if value % 1:
                    raise InputError(f"the camera's {name} is {given!r}; give whole pixels")
                value = int(value)
            object.__setattr__(self, name, value)
        lens = [to_float(value) for value in np.ravel(self.distortion)]
        if not all(map(math.isfinite, lens)):
            raise InputError(f"the camera's distortion is {self.distortion!r}; give the numbers k1, k2, p1, p2, k3")
        object.__setattr__(self, "distortion", (*lens, *[0.0] * (5 - len(lens))))
        if self.readout is not None:
            readout = to_float(self.readout)
            if not abs(readout) <= MAX_READOUT:
                raise InputError(f"the camera's readout is {self.readout!r}; give seconds, at most {MAX_READOUT}")
            object.__setattr__(self, "readout", readout)

    def __getstate__(self) -> dict[str, object]:
        """What it is made of: what is cached follows from that, and takes megabytes."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

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
            Shape :math:`(N, 2)`, float64, without gradients.
        """
        uv = uv.to(torch.float64)
        if not self.is_distorted or uv.shape[0] == 0:
            return uv
        # With the strong lens of TUM's fr1 the corners need up to 20 steps, and a millionth of a pixel is enough.
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)
        lens = np.array(self.distortion)
        return torch.from_numpy(cv2.undistortImagePoints(uv.numpy(), self.K.numpy(), lens, None, until)).view_as(uv)

    def distort(self, uv: Tensor) -> Tensor:
        """Pixels of an ideal pinhole camera to pixels of the image as delivered: the inverse of `undistort`.

        Args:
            uv: shape :math:`(N, 2)`, floating point.

        Returns:
            Shape :math:`(N, 2)`, float64.
        """
        return self._image(self.slopes(uv)) if self.is_distorted else uv.to(torch.float64)

    def slopes(self, uv: Tensor) -> Tensor:
        """Directions (x / z, y / z) through pixels of an ideal pinhole camera, :math:`(N, 2)`, float64 both ways."""
        return (uv.to(torch.float64) - self._centre) / self.focal

    @cached_property
    def focal(self) -> Tensor:
        """Focal lengths along u and v, pixels, float64, shape :math:`(2,)`."""
        return torch.tensor([self.fx, self.fy], dtype=torch.float64)

    @cached_property
    def _centre(self) -> Tensor:
        """Principal point, pixels, float64, shape (2,)."""
        return torch.tensor([self.cx, self.cy], dtype=torch.float64)

    def _image(self, slope: Tensor) -> Tensor:
        """Directions (x / z, y / z) to pixels as delivered, by the Brown model, both (N, 2) and float64."""
        if self.is_distorted:
            k1, k2, p1, p2, k3 = self.distortion
            tangential = slope.new_tensor([p2, p1])
            square = slope.square().sum(dim=1, keepdim=True)
            radial = 1 + square * (k1 + square * (k2 + square * k3))
            slope = slope * (radial + 2 * (slope @ tangential)[:, None]) + square * tangential
        return slope * self.focal + self._centre

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

    @cached_property
    def _field(self) -> Tensor:
        """Least and greatest x / z and y / z of all that is in the image, with a pixel to spare, shape (2, 2)."""
        ends = self.rays[..., :2].flatten(0, 1).to(torch.float64).aminmax(dim=0)
        pixel = torch.tensor([1 / self.fx, 1 / self.fy], dtype=torch.float64)
        return torch.stack([ends.min - pixel, ends.max + pixel])

    def locate(self, points: Tensor, min_depth: float) -> tuple[Tensor, Tensor]:
        """Pixels of points in the image as delivered, and whether they are before the camera and in its field.

        A lens' polynomial maps some of what lies far outside of the image into it: such points are not in the field.

        Args:
            points: camera frame, metres, shape :math:`(P, 3)`.
            min_depth: nearer points are not seen, metres.

        Returns:
            (u, v), float64, shape :math:`(P, 2)`, and bool, shape :math:`(P,)`.
        """
        slope = points[:, :2] / points[:, 2:]
        low, high = self._field
        seen = (points[:, 2] > min_depth) & ((slope >= low) & (slope <= high)).all(dim=1)
        pixels = self._image(torch.where(seen[:, None], slope, 0.0).to(torch.float64))
        return pixels, seen & ((pixels >= -0.5) & (pixels < self._size - 0.5)).all(dim=1)

    @cached_property
    def _size(self) -> Tensor:
        """Width and height, pixels, float64, shape (2,)."""
        return torch.tensor([self.width, self.height], dtype=torch.float64)

    def back_project(self, uv: Tensor, depth: Tensor) -> Tensor:
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
        return self.back_project(pixels, ones).reshape(self.height, self.width, 3).to(torch.float32)


def back_project(depth: Tensor, rays: Tensor) -> Tensor:
    r"""Depth image to a point per pixel: :math:`x = (u - c_x) z / f_x,\; y = (v - c_y) z / f_y` (paper, Sec. III-B.1).

    Args:
        depth: metres along z, float32 or float64, shape :math:`(B, 1, H, W)`; 0 = no measurement.
        rays: direction through every pixel at unit depth, shape :math:`(H, W, 3)`, or :math:`(B, H, W, 3)` for a camera
            each; see `PinholeCamera.rays`.

    Returns:
        Points in the camera frame, metres, dtype of ``depth``, shape :math:`(B, H, W, 3)`; (0, 0, 0) where there is no
        depth. Differentiable in ``depth`` and, for cameras that are learnt, in ``rays``.
    """
    KORNIA_CHECK_SHAPE(depth, ["B", "1", "H", "W"])
    KORNIA_CHECK_SHAPE(rays, ["*", *map(str, depth.shape[2:]), "3"])
    return rays.to(depth.dtype) * depth[:, 0, :, :, None]


class BackProjector(torch.nn.Module):
    """:func:`back_project` as a module.

    Args:
        camera: gives the ray of each pixel, lens distortion included.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__()
        self._camera = camera

    def forward(self, depth: Tensor) -> Tensor:
        """Back-project depth images, metres, shape :math:`(B, 1, H, W)`; see :func:`back_project`."""
        return back_project(depth, self._camera.rays)
