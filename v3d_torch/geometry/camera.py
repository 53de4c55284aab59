"""Pinhole camera with lens distortion: projection, back-projection, pixel rays (paper, Sec. III-B.1)."""

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
from v3d_torch.kernels.camera import Bounds, Intrinsics

MAX_READOUT = 0.05
"""Longest accepted readout, seconds: no RGB-D camera takes longer to read the rows of an image."""

# The corners of an image with strong lens distortion take about 20 steps. The tolerance is in pixels.
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an RGB-D camera whose depth image is registered to its colour image.

    Convention: x right, y down, z forward, metres. Pixels are (u, v) = (column, row), and pixel centres lie at
    integers. An *undistorted* pixel is the projection by ``K`` alone; a *distorted* pixel is a position in the recorded
    image, with lens distortion.

    Args:
        fx: Focal length along u, pixels.
        fy: Focal length along v, pixels.
        cx: Principal point along u, pixels.
        cy: Principal point along v, pixels.
        width: Number of image columns.
        height: Number of image rows.
        distortion: Coefficients k1, k2, p1, p2, k3 of the Brown-Conrady model in OpenCV's order. An array of four or
            five coefficients, as OpenCV returns it, is accepted.
        depth_scale: Units of the depth image per metre (TUM: 5000).
        readout: Time from the first to the last row of a colour image, seconds. 0 for a global shutter, negative if the
            rows are read from the bottom up, None if unknown; an unknown readout is calibrated while mapping.

    Raises:
        InputError: If a value is not a finite number in its range. Focal lengths are positive: a negative ``fy``, as
            published with ICL-NUIM, describes a y axis that points up.
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
        coefficients = [to_float(value) for value in np.ravel(self.distortion)]
        if not all(map(math.isfinite, coefficients)):
            raise InputError(f"the camera's distortion is {self.distortion!r}; give the numbers k1, k2, p1, p2, k3")
        object.__setattr__(self, "distortion", (*coefficients, *[0.0] * (5 - len(coefficients))))
        if self.readout is not None:
            readout = to_float(self.readout)
            if not abs(readout) <= MAX_READOUT:
                raise InputError(f"the camera's readout is {self.readout!r}; give seconds, at most {MAX_READOUT}")
            object.__setattr__(self, "readout", readout)

    def __getstate__(self) -> dict[str, object]:
        """Fields without the cached tensors, which follow from them and take megabytes."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def K(self) -> Tensor:
        """Camera matrix, float64, shape :math:`(3, 3)`."""
        return torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    @cached_property
    def focal_lengths(self) -> Tensor:
        """Focal lengths along u and v, pixels, float64, shape :math:`(2,)`."""
        return torch.tensor([self.fx, self.fy], dtype=torch.float64)

    @cached_property
    def _principal_point(self) -> Tensor:
        """Principal point (u, v), pixels, float64, shape (2,)."""
        return torch.tensor([self.cx, self.cy], dtype=torch.float64)

    @cached_property
    def _size(self) -> Tensor:
        """Width and height, pixels, float64, shape (2,)."""
        return torch.tensor([self.width, self.height], dtype=torch.float64)

    @cached_property
    def intrinsics(self) -> Intrinsics:
        """Focal lengths, principal point and distortion coefficients as numbers, for kernels."""
        return (self.fx, self.fy, self.cx, self.cy, *self.distortion)

    @cached_property
    def bounds(self) -> Bounds:
        """Extent of the image in normalised coordinates, with a margin of one pixel, and its size, for kernels."""
        (x_min, y_min), (x_max, y_max) = self._normalised_bounds.tolist()
        return x_min, x_max, y_min, y_max, float(self.width), float(self.height)

    @property
    def is_distorted(self) -> bool:
        """True if any distortion coefficient is not 0."""
        return any(self.distortion)

    def undistort(self, uv: Tensor) -> Tensor:
        """Map distorted pixels to undistorted pixels.

        Args:
            uv: Pixels in the recorded image, floating point, shape :math:`(N, 2)`.

        Returns:
            Pixels of an ideal pinhole camera with the same ``K``, float64, shape :math:`(N, 2)`, without gradients.
        """
        uv = uv.to(torch.float64)
        if not self.is_distorted or uv.shape[0] == 0:
            return uv
        K, coefficients = self.K.numpy(), np.array(self.distortion)
        pixels = cv2.undistortImagePoints(uv.numpy(), K, coefficients, None, _UNDISTORT_CRITERIA)
        return torch.from_numpy(pixels).view_as(uv)

    def distort(self, uv: Tensor) -> Tensor:
        """Map undistorted pixels to distorted pixels; the inverse of `undistort`.

        Args:
            uv: Pixels of an ideal pinhole camera, floating point, shape :math:`(N, 2)`.

        Returns:
            Pixels in the recorded image, float64, shape :math:`(N, 2)`.
        """
        return self._project_normalised(self.normalise(uv)) if self.is_distorted else uv.to(torch.float64)

    def normalise(self, uv: Tensor) -> Tensor:
        """Normalised image coordinates (x / z, y / z) of undistorted pixels.

        Args:
            uv: Undistorted pixels, shape :math:`(N, 2)`.

        Returns:
            Float64, shape :math:`(N, 2)`.
        """
        return (uv.to(torch.float64) - self._principal_point.to(uv.device)) / self.focal_lengths.to(uv.device)

    def _project_normalised(self, xy: Tensor) -> Tensor:
        """Distorted pixels at normalised image coordinates, by the Brown-Conrady model, both (N, 2) and float64."""
        if self.is_distorted:
            k1, k2, p1, p2, k3 = self.distortion
            tangential = xy.new_tensor([p2, p1])
            r2 = xy.square().sum(dim=1, keepdim=True)
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            xy = xy * (radial + 2 * (xy @ tangential)[:, None]) + r2 * tangential
        return xy * self.focal_lengths.to(xy.device) + self._principal_point.to(xy.device)

    def project(self, points: Tensor) -> Tensor:
        r"""Project points to undistorted pixels: :math:`u = f_x x / z + c_x,\; v = f_y y / z + c_y`.

        Args:
            points: Points in the camera frame, metres, shape :math:`(..., 3)`; z must not be 0.

        Returns:
            Undistorted pixels (u, v), shape :math:`(..., 2)`.
        """
        u = self.fx * points[..., 0] / points[..., 2] + self.cx
        v = self.fy * points[..., 1] / points[..., 2] + self.cy
        return torch.stack([u, v], dim=-1)

    @cached_property
    def _normalised_bounds(self) -> Tensor:
        """Minimum and maximum (x / z, y / z) of the image, with a margin of one pixel, shape (2, 2)."""
        extremes = self.rays[..., :2].flatten(0, 1).to(torch.float64).aminmax(dim=0)
        pixel = torch.tensor([1 / self.fx, 1 / self.fy], dtype=torch.float64)
        return torch.stack([extremes.min - pixel, extremes.max + pixel])

    def project_to_image(self, points: Tensor, min_depth: float) -> tuple[Tensor, Tensor]:
        """Project points to distorted pixels and check which of them lie in the image.

        Points outside the field of view are rejected before distortion, because the distortion polynomial maps some of
        them back into the image.

        Args:
            points: Points in the camera frame, metres, shape :math:`(P, 3)`.
            min_depth: Points with a depth up to this are not in the image, metres.

        Returns:
            Distorted pixels (u, v), float64, shape :math:`(P, 2)`, and a mask of the points in the image, bool, shape
            :math:`(P,)`. Pixels of points outside the mask are meaningless.
        """
        xy = points[:, :2] / points[:, 2:]
        low, high = self._normalised_bounds
        in_view = (points[:, 2] > min_depth) & ((xy >= low) & (xy <= high)).all(dim=1)
        pixels = self._project_normalised(torch.where(in_view[:, None], xy, 0.0).to(torch.float64))
        return pixels, in_view & ((pixels >= -0.5) & (pixels < self._size - 0.5)).all(dim=1)

    def back_project(self, uv: Tensor, depth: Tensor) -> Tensor:
        r"""Back-project undistorted pixels: :math:`x = (u - c_x) z / f_x,\; y = (v - c_y) z / f_y`.

        Args:
            uv: Undistorted pixels, shape :math:`(..., 2)`.
            depth: Depth along z, metres, shape :math:`(...)`.

        Returns:
            Points in the camera frame, metres, shape :math:`(..., 3)`.
        """
        x = (uv[..., 0] - self.cx) / self.fx
        y = (uv[..., 1] - self.cy) / self.fy
        return torch.stack([x * depth, y * depth, depth], dim=-1)

    @cached_property
    def rays(self) -> Tensor:
        """Viewing ray of every pixel of the recorded image at unit depth, float32, shape :math:`(H, W, 3)`."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=torch.float64),
            torch.arange(self.width, dtype=torch.float64),
            indexing="ij",
        )
        pixels = self.undistort(torch.stack([u, v], dim=-1).reshape(-1, 2))
        ones = torch.ones(pixels.shape[0], dtype=torch.float64)
        return self.back_project(pixels, ones).reshape(self.height, self.width, 3).to(torch.float32)


def back_project(depth: Tensor, rays: Tensor) -> Tensor:
    r"""Back-project a depth image: :math:`x = (u - c_x) z / f_x,\; y = (v - c_y) z / f_y` (paper, Sec. III-B.1).

    Args:
        depth: Depth along z, metres, float32 or float64, shape :math:`(B, 1, H, W)`; 0 = no measurement.
        rays: Viewing ray of every pixel at unit depth, shape :math:`(H, W, 3)`, or :math:`(B, H, W, 3)` for one camera
            per image; see `PinholeCamera.rays`.

    Returns:
        Points in the camera frame, metres, dtype of ``depth``, shape :math:`(B, H, W, 3)`; (0, 0, 0) for pixels without
        depth. Differentiable in ``depth`` and ``rays``.
    """
    KORNIA_CHECK_SHAPE(depth, ["B", "1", "H", "W"])
    KORNIA_CHECK_SHAPE(rays, ["*", *map(str, depth.shape[2:]), "3"])
    return rays.to(depth.dtype) * depth[:, 0, :, :, None]


class BackProjector(torch.nn.Module):
    """Back-projection of depth images as a module; see :func:`back_project`.

    Args:
        camera: Camera of the depth images; lens distortion is taken into account.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__()
        self._camera = camera

    def forward(self, depth: Tensor) -> Tensor:
        """Back-project depth images, metres, shape :math:`(B, 1, H, W)`; see :func:`back_project`."""
        return back_project(depth, self._camera.rays)
