"""Pinhole camera with lens distortion: projection, back-projection, pixel rays (paper, Sec. III-B.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

from v3d_torch.config.validation import to_float
from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_shape
from v3d_torch.geometry.distortion import (
    DistortionModel,
    complete_distortion,
    distort,
    kernel_coefficients,
    undistort_pixels,
)
from v3d_torch.geometry.precision import result_dtype
from v3d_torch.kernels.camera import Bounds, Intrinsics

MAX_READOUT = 0.05
"""Longest accepted readout, seconds: no RGB-D camera takes longer to read the rows of an image."""

MAX_DEPTH_DELAY = 0.5
"""Longest accepted depth delay, seconds: images that are farther apart are not of the same frame."""

MAX_INVERSE_DEPTH_OFFSET = 0.05
"""Largest accepted offset of inverse depth, 1/m: it changes a depth of 2 m by 0.2 m."""

NEGATIVE_FY = (
    "a negative fy, as published with ICL-NUIM, means that y points up; in images y points down, so give its absolute"
    " value, and mirror the y axis of the ground truth"
)
"""Explanation of a negative focal length along v."""


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
        distortion: Coefficients of the distortion model in OpenCV's order, see `COEFFICIENTS`. An array as OpenCV
            returns it, with four, five or eight coefficients, is accepted.
        depth_scale: Units per metre of depth images with whole numbers (TUM: 5000, millimetres: 1000); None if it is
            not known. Depth images in floating point are in metres and need no depth scale.
        readout: Time from the first to the last row of a colour image, seconds. 0 for a global shutter, negative if the
            rows are read from the bottom up, None if unknown; an unknown readout is calibrated while mapping.
        distortion_model: Name of the distortion model in ROS: ``plumb_bob`` (Brown-Conrady), ``rational_polynomial``
            (eight coefficients) or ``equidistant`` (fisheye, Kannala-Brandt). As in OpenCV, the number of coefficients
            distinguishes the first two.
        depth_delay: Time of the depth image minus time of the colour image, seconds, in addition to the difference of
            their timestamps.
        inverse_depth_offset: Offset of the true inverse depth from the measured one, 1/m; see `correct_depth`.

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
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float | None = None
    readout: float | None = None
    distortion_model: DistortionModel = "plumb_bob"
    depth_delay: float = 0.0
    inverse_depth_offset: float = 0.0

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "width", "height", "depth_scale"):
            given = getattr(self, name)
            if name == "depth_scale" and given is None:
                continue
            value = to_float(given)
            if not math.isfinite(value) or (value <= 0 and name not in ("cx", "cy")):
                above = "" if name in ("cx", "cy") else " above 0"
                hint = f" ({NEGATIVE_FY})" if name == "fy" and value < 0 else ""
                raise InputError(f"the camera's {name} is {given!r}; give a finite number{above}{hint}")
            if name in ("width", "height"):
                if value % 1:
                    raise InputError(f"the camera's {name} is {given!r}; give whole pixels")
                value = int(value)
            object.__setattr__(self, name, value)
        distortion, model = complete_distortion(self.distortion, self.distortion_model)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "distortion_model", model)
        if self.readout is not None:
            readout = to_float(self.readout)
            if not abs(readout) <= MAX_READOUT:
                raise InputError(f"the camera's readout is {self.readout!r}; give seconds, at most {MAX_READOUT}")
            object.__setattr__(self, "readout", readout)
        for name, limit in (("depth_delay", MAX_DEPTH_DELAY), ("inverse_depth_offset", MAX_INVERSE_DEPTH_OFFSET)):
            value = to_float(getattr(self, name))
            if not abs(value) <= limit:
                raise InputError(f"the camera's {name} is {getattr(self, name)!r}; give a number, at most {limit}")
            object.__setattr__(self, name, value)

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without the cached tensors, which take megabytes and can be computed again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def K(self) -> Tensor:
        """Camera matrix, float64, shape :math:`(3, 3)`; a new tensor, which the caller may change."""
        return self._K.clone()

    @cached_property
    @torch.inference_mode(False)  # like all cached tensors, it can later be used where gradients are required
    def _K(self) -> Tensor:
        """Camera matrix, float64, shape (3, 3)."""
        return torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    @cached_property
    @torch.inference_mode(False)
    def focal_lengths(self) -> Tensor:
        """Focal lengths along u and v, pixels, float64, shape :math:`(2,)`.

        The property returns the same tensor each time; clone it before you change it.
        """
        return torch.tensor([self.fx, self.fy], dtype=torch.float64)

    @cached_property
    @torch.inference_mode(False)
    def _principal_point(self) -> Tensor:
        """Principal point (u, v), pixels, float64, shape (2,)."""
        return torch.tensor([self.cx, self.cy], dtype=torch.float64)

    @cached_property
    @torch.inference_mode(False)
    def _size(self) -> Tensor:
        """Width and height, pixels, float64, shape (2,)."""
        return torch.tensor([self.width, self.height], dtype=torch.float64)

    @cached_property
    def intrinsics(self) -> Intrinsics:
        """Focal lengths, principal point and distortion coefficients as numbers, for kernels."""
        coefficients = kernel_coefficients(self.distortion_model, self.distortion)
        return cast("Intrinsics", (self.fx, self.fy, self.cx, self.cy, *coefficients))

    @cached_property
    def bounds(self) -> Bounds:
        """Extent of the image in normalised coordinates, with a margin of one pixel, and its size, for kernels."""
        (x_min, y_min), (x_max, y_max) = self._normalised_bounds.tolist()
        return x_min, x_max, y_min, y_max, float(self.width), float(self.height)

    @property
    def is_distorted(self) -> bool:
        """True if undistorted and distorted pixels differ: a coefficient is not 0, or the model is ``equidistant``."""
        return self.distortion_model == "equidistant" or any(self.distortion)

    def undistort(self, uv: Tensor) -> Tensor:
        """Map distorted pixels to undistorted pixels.

        Args:
            uv: Pixels in the recorded image, floating point, shape :math:`(N, 2)`.

        Returns:
            Pixels of an ideal pinhole camera with the same ``K``, float64, shape :math:`(N, 2)`, without gradients.
        """
        uv = uv.detach().to(torch.float64)
        if not self.is_distorted or uv.shape[0] == 0:
            return uv
        return undistort_pixels(uv, self.K, self.distortion_model, self.distortion)

    def correct_depth(self, depth: Tensor) -> Tensor:
        r"""Correct measured depth by the camera's offset of inverse depth: :math:`1 / z = 1 / z_{measured} + \beta`.

        Structured-light and stereo cameras measure disparity, which is linear in inverse depth. An error of the zero
        point of disparity is a constant offset of inverse depth, and causes an error of depth that grows with the
        square of depth (Khoshelham and Elberink, Accuracy and Resolution of Kinect Depth Data, Sensors 2012).

        Args:
            depth: Measured depth, metres, any shape; 0 or not finite = no measurement.

        Returns:
            Corrected depth, 0 without a measurement and where it would be infinite; the same tensor without an offset.
        """
        if not self.inverse_depth_offset:
            return depth
        relative = 1 + self.inverse_depth_offset * depth  # inverse depth, true over measured
        return torch.where((relative > 0) & depth.isfinite(), depth / relative, 0.0)

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
        """Distorted pixels at normalised image coordinates, both (N, 2) and float64."""
        if self.is_distorted:
            xy = distort(xy, self.distortion_model, self.distortion)
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
    @torch.inference_mode(False)
    def _normalised_bounds(self) -> Tensor:
        """Minimum and maximum (x / z, y / z) of the image, with a margin of one pixel, shape (2, 2)."""
        extremes = self.rays[..., :2].flatten(0, 1).to(torch.float64).aminmax(dim=0)
        pixel = torch.tensor([1 / self.fx, 1 / self.fy], dtype=torch.float64)
        return torch.stack([extremes.min - pixel, extremes.max + pixel])

    @cached_property
    def undistorted_bounds(self) -> tuple[float, float, float, float]:
        """Extent of the image and its undistorted pixels: minimum u and v, inclusive, and maximum u and v, exclusive.

        The undistorted image of a wide lens is much larger than the recorded image. Where it is smaller, predicted
        positions between the two borders count as in the image, because predictions have errors.
        """
        width, height = float(self.width), float(self.height)
        if not self.is_distorted:
            return 0.0, 0.0, width, height
        low, high = (self._normalised_bounds * self.focal_lengths + self._principal_point).tolist()
        return min(low[0], 0.0), min(low[1], 0.0), max(high[0], width), max(high[1], height)

    def project_to_image(self, points: Tensor, min_depth: float) -> tuple[Tensor, Tensor]:
        """Project points to distorted pixels and check which of them lie in the image.

        Points outside the field of view are rejected before distortion, because the distortion polynomial maps some of
        them back into the image.

        Args:
            points: Points in the camera frame, metres, shape :math:`(P, 3)`.
            min_depth: Points with at most this depth are not in the image, metres.

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
    @torch.inference_mode(False)
    def rays(self) -> Tensor:
        """Viewing ray of every pixel of the recorded image at unit depth, float32, shape :math:`(H, W, 3)`.

        The property returns the same tensor each time; clone it before you change it.
        """
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
        depth: Depth along z, metres, shape :math:`(B, 1, H, W)`; 0 = no measurement.
        rays: Viewing ray of every pixel at unit depth, shape :math:`(H, W, 3)`, or :math:`(B, H, W, 3)` for one camera
            per image; see `PinholeCamera.rays`.

    Returns:
        Points in the camera frame, metres, dtype of ``depth``, float32 for integers, shape :math:`(B, H, W, 3)`;
        (0, 0, 0) where the depth is 0, and not finite where it is not. Differentiable in ``depth`` and ``rays``.
    """
    check_shape("depth", depth, "B", 1, "H", "W")
    check_shape("rays", rays, "*", *depth.shape[2:], 3)
    return rays.to(depth.device, result_dtype(depth.dtype)) * depth[:, 0, :, :, None]


class BackProjector(torch.nn.Module):
    """Back-projection of depth images as a module; see :func:`back_project`.

    Args:
        camera: Camera of the depth images; lens distortion is taken into account.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__()
        self._camera = camera

    def forward(self, depth: Tensor) -> Tensor:
        """Back-project depth images, metres, shape :math:`(B, 1, H, W)`; see :func:`back_project`.

        Raises:
            ShapeError: If the images do not have the size of the camera.
        """
        check_shape("depth", depth, "B", 1, self._camera.height, self._camera.width)
        return back_project(depth, self._camera.rays)
