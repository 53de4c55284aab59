"""Dense RGB-D alignment: camera motion from all pixels, for blur, low light and few corners, where features fail.

Brightness and inverse depth are two images warped by the same motion. Both residuals are minimised together, coarse to
fine, with the weights of a t-distribution (Kerl, Sturm and Cremers: Robust Odometry Estimation for RGB-D Cameras, ICRA
2013; Dense Visual SLAM for RGB-D Cameras, IROS 2013). The inverse depth of a plane is linear in the image, so the
whitened residual is a point-to-plane distance in units of the sensor noise.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_masks
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.precision import without_autocast
from v3d_torch.geometry.se3 import adjoint, invert, orthonormalise
from v3d_torch.odometry.dense_problem import AlignmentProblem, State, System, step
from v3d_torch.odometry.dense_view import DenseView, LevelCamera
from v3d_torch.optim.levenberg_marquardt import POSE_TOLERANCE, OptimisationResult, levenberg_marquardt
from v3d_torch.runtime.batches import check_shapes

_COARSE_INVERSE_DEPTH_SIGMA = 0.02
"""Minimum standard deviation of inverse depth on all levels but the finest, 1/m. It reduces the weight of depth there:
depth is measured at another time than colour, and in a fast turn the two fit different motions."""

_MIN_INLIER_RATIO = 0.75
"""Minimum fraction of the points whose depth agrees, among the points with depth in both views."""

_MIN_CORRELATION = 0.9
"""Minimum correlation of the brightness of both views. Unlike a residual, it does not depend on exposure."""

_MIN_CONTRAST = 2e-3
"""Minimum standard deviation of brightness on the coarsest level: half an 8-bit step."""

_MAX_DEPTH_SIGMAS = 5.0
"""Maximum difference at which depths agree, in standard deviations of inverse depth. It is large because the delay
between colour and depth, and depth edges, make the residuals heavy-tailed."""


class DenseAlignment(NamedTuple):
    """Motion between two views found by dense alignment, with measures of its quality.

    Attributes:
        T_ba: Maps points from the reference's camera a to the current camera b, float64, shape :math:`(*, 4, 4)`.
        reliable: True if all measures of quality are within their limits, bool, shape :math:`(*)`. All other attributes
            have this shape unless stated otherwise.
        overlap: Fraction of the reference points that lie on static pixels of the current view.
        inliers: Number of points whose depth agrees in both views, int64.
        inlier_ratio: Inliers as a fraction of the points with depth in both views.
        correlation: Correlation of the brightness of both views at the same points, from -1 to 1.
        photometric_rms: Root mean square of the brightness residuals after gain and bias, in brightness of the current
            image.
        geometric_rms: Root mean square of the inverse-depth residuals, 1/m.
        information: Information matrix (inverse covariance) of the left perturbation ``exp(xi) @ T_ba``,
            ``xi = [translation, rotation]``, metres and radians, with gain and bias marginalised, float64, shape
            :math:`(*, 6, 6)`. It assumes that the errors of pixels are independent, so its scale is too large.
        observability: Ratio of the smallest to the largest eigenvalue of the information, with translation in units of
            the median depth.
    """

    T_ba: Tensor
    reliable: Tensor
    overlap: Tensor
    inliers: Tensor
    inlier_ratio: Tensor
    correlation: Tensor
    photometric_rms: Tensor
    geometric_rms: Tensor
    information: Tensor
    observability: Tensor


def align_depth(
    grey_a: Tensor,
    depth_a: Tensor,
    grey_b: Tensor,
    depth_b: Tensor,
    camera: PinholeCamera,
    T_ba: Tensor | None = None,
    static_a: Tensor | None = None,
    static_b: Tensor | None = None,
    *,
    config: DenseOdometryConfig | None = None,
) -> DenseAlignment:
    """Estimate the motion between RGB-D images from all pixels: dense alignment of brightness and depth.

    Brightness and inverse-depth residuals are minimised together, coarse to fine, with the weights of a t-distribution,
    and with gain and bias between the two images. The pairs of a batch are aligned one after the other, because the
    number of usable pixels differs between them. The result has no gradients.

    Kerl, Sturm and Cremers, Robust Odometry Estimation for RGB-D Cameras, ICRA 2013; Dense Visual SLAM for RGB-D
    Cameras, IROS 2013.

    Args:
        grey_a: Brightness of the reference images, from 0 to 1, with lens distortion, floating point, shape
            :math:`(*, 1, H, W)`; converted to float32.
        depth_a: Depth of the reference images, metres, shape :math:`(*, 1, H, W)`; 0 = no measurement.
        grey_b: Brightness of the current images, shape :math:`(*, 1, H, W)`.
        depth_b: Depth of the current images, metres, shape :math:`(*, 1, H, W)`.
        camera: Camera of all images, with lens distortion.
        T_ba: Predicted motion, from the reference's camera to the current one, shape :math:`(*, 4, 4)`; the identity by
            default.
        static_a: Pixels of the reference images to align, bool, shape :math:`(*, H, W)`; None for all.
        static_b: Pixels of the current images to align, bool, shape :math:`(*, H, W)`; None for all.
        config: Pyramid levels, noise, limits of the quality; None for the default.

    Returns:
        The motion and its quality; all NaN and not reliable if an image has no contrast or no depth.

    Raises:
        InputError: If the images do not have the size of the camera or fewer than 2 rows or columns, or a mask is not
            bool.
    """
    align = DenseAligner(config or DenseOdometryConfig(), camera)
    alignment: DenseAlignment = align(grey_a, depth_a, grey_b, depth_b, T_ba, static_a, static_b)
    return alignment


class DenseAligner(torch.nn.Module):
    """:func:`align_depth` as a module that computes the camera models of its pyramid levels once.

    Args:
        config: Pyramid levels, noise, limits of the quality.
        camera: Camera of both views, with lens distortion. Levels with fewer than 2 rows or columns are skipped.

    Raises:
        InputError: If images have fewer than 2 rows or columns.
    """

    def __init__(self, config: DenseOdometryConfig, camera: PinholeCamera) -> None:
        super().__init__()
        size = min(camera.width, camera.height)
        if size < 2:
            raise InputError(
                f"images of {camera.width} x {camera.height} pixels have no gradients along both axes; dense alignment"
                " needs at least 2 rows and 2 columns"
            )
        self._config, self._size = config, (camera.height, camera.width)
        self._halvings = tuple(halvings for halvings in config.halvings if size >= 2 << halvings) or (0,)
        self._cameras = {halvings: LevelCamera.from_camera(camera, halvings) for halvings in self._halvings}

    def view(self, grey: Tensor, depth: Tensor, static: Tensor) -> DenseView:
        """Prepare a frame for alignment; see `DenseView`."""
        return DenseView(grey, depth, static, self._cameras, self._config)

    @torch.no_grad()
    @without_autocast
    def forward(
        self,
        grey_a: Tensor,
        depth_a: Tensor,
        grey_b: Tensor,
        depth_b: Tensor,
        T_ba: Tensor | None = None,
        static_a: Tensor | None = None,
        static_b: Tensor | None = None,
    ) -> DenseAlignment:
        """Align images :math:`(*, 1, H, W)`; see :func:`align_depth`."""
        check_masks(static_a=static_a, static_b=static_b)
        batch = check_shapes(
            grey_a=(grey_a, 1, "H", "W"),
            depth_a=(depth_a, 1, "H", "W"),
            grey_b=(grey_b, 1, "H", "W"),
            depth_b=(depth_b, 1, "H", "W"),
            T_ba=(T_ba, 4, 4),
            static_a=(static_a, "H", "W"),
            static_b=(static_b, "H", "W"),
        )
        size = grey_a.shape[-2:]
        if size != self._size:
            raise InputError(
                f"the images have {size[1]} x {size[0]} pixels, the camera {self._size[1]} x {self._size[0]}; give a"
                " camera of the size of the images"
            )
        images = grey_a, depth_a, grey_b, depth_b
        motion = torch.eye(4, dtype=torch.float64, device=grey_a.device) if T_ba is None else T_ba.to(torch.float64)
        pixels = grey_a.new_ones(size, dtype=torch.bool)
        masks = (pixels if static is None else static for static in (static_a, static_b))
        columns = (
            *(image.to(torch.float32).expand(*batch, 1, *size).reshape(-1, 1, *size) for image in images),
            motion.expand(*batch, 4, 4).reshape(-1, 4, 4),
            *(mask.expand(*batch, *size).reshape(-1, *size) for mask in masks),
        )
        alignments = [
            self._align(self.view(grey_a, depth_a, static_a), self.view(grey_b, depth_b, static_b), T_ba)
            for grey_a, depth_a, grey_b, depth_b, T_ba, static_a, static_b in zip(*columns, strict=True)
        ]
        # The rows start with an extra element, dropped below, so that an empty batch can be stacked.
        failed = _failed_alignment(grey_a.device)
        rows = [failed, *(failed if alignment is None else alignment for alignment in alignments)]
        stacked = (torch.stack(list(column))[1:] for column in zip(*rows, strict=True))
        return DenseAlignment(*(column.reshape((*batch, *column.shape[1:])) for column in stacked))

    @torch.no_grad()
    def align_views(self, a: DenseView, b: DenseView, T_ba: Tensor) -> DenseAlignment | None:
        """Estimate the motion from the reference view a to the current view b.

        Args:
            a: Reference view; its points with depth are aligned.
            b: Current view.
            T_ba: Predicted motion, float64, shape :math:`(4, 4)`.

        Returns:
            None if the result is not reliable: an image has no contrast, the overlap is too small, a direction of
            motion is not observable, or the views disagree at the optimum.
        """
        alignment = self._align(a, b, T_ba)
        return alignment if alignment is not None and bool(alignment.reliable) else None

    def _align(self, a: DenseView, b: DenseView, T_ba: Tensor) -> DenseAlignment | None:
        *_, finest = self._halvings
        gain_and_bias = self._initial_gain_and_bias(a, b)
        if gain_and_bias is None or not T_ba.isfinite().all() or not len(a.levels[finest].reference_points.points):
            return None
        state = (T_ba, gain_and_bias)
        for halvings in self._halvings:
            sigma = self._config.inverse_depth_sigma if halvings == finest else _COARSE_INVERSE_DEPTH_SIGMA
            problem = AlignmentProblem(a.levels[halvings], b.levels[halvings], state, sigma, self._config)
            result = levenberg_marquardt(
                state, problem.linearise, step, self._config.iterations, tolerance=POSE_TOLERANCE
            )
            state = result.state
        return self._summarise(problem, result)

    def _initial_gain_and_bias(self, a: DenseView, b: DenseView) -> Tensor | None:
        """Gain and bias from the contrast and mean of both images, shape (2,); None if either has no contrast."""
        coarsest = self._halvings[0]
        greys = [view.levels[coarsest].channels[0] for view in (a, b)]
        greys = [grey[grey.isfinite()].to(torch.float64) for grey in greys]
        mean_a, mean_b = (grey.mean() for grey in greys)
        contrast_a, contrast_b = ((grey - grey.mean()).square().mean().sqrt() for grey in greys)
        if not min(contrast_a, contrast_b) > _MIN_CONTRAST:  # also true for NaN, if no pixel is static
            return None
        gain = contrast_b / contrast_a
        return torch.stack([gain, mean_b - gain * mean_a])

    def _summarise(self, problem: AlignmentProblem, result: OptimisationResult[State, System]) -> DenseAlignment:
        T_ba, (gain, _) = orthonormalise(result.state[0]), result.state[1]
        residuals, config = problem.residuals(result.state), self._config
        (brightness, inverse_depth), valid_brightness = problem.reference.values.to(torch.float64), residuals.valid[0]
        inliers = residuals.valid[1] & (residuals.values[1].abs() <= _MAX_DEPTH_SIGMAS * config.inverse_depth_sigma)
        rms = [r[v].square().mean().sqrt() for r, v in zip(residuals.values, residuals.valid, strict=True)]
        information = problem.information(result.system, valid_brightness)
        scale = torch.ones_like(information[0])
        scale[:3] = 1 / inverse_depth.median()
        eigenvalues = torch.linalg.eigvalsh(scale[:, None] * information * scale)
        left_to_right = adjoint(invert(T_ba))  # exp(xi) T = T exp(Ad(T^-1) xi)
        overlap = residuals.in_view.to(torch.float64).mean()
        inlier_ratio = (inliers.sum() / (residuals.valid[1] | residuals.occluded).sum()).to(torch.float64)
        correlation = _correlation(
            brightness[valid_brightness], (gain * brightness + residuals.values[0])[valid_brightness]
        )
        observability = eigenvalues[0] / eigenvalues[-1]
        limits = config.min_overlap, _MIN_INLIER_RATIO, _MIN_CORRELATION, config.min_observability
        measures = overlap, inlier_ratio, correlation, observability
        return DenseAlignment(
            T_ba=T_ba,
            # False for NaN.
            reliable=torch.stack([each >= limit for each, limit in zip(measures, limits, strict=True)]).all(),
            overlap=overlap,
            inliers=inliers.sum(),
            inlier_ratio=inlier_ratio,
            correlation=correlation,
            photometric_rms=rms[0],
            geometric_rms=rms[1],
            information=left_to_right.mT @ information @ left_to_right,
            observability=observability,
        )


def _failed_alignment(device: torch.device) -> DenseAlignment:
    """Result for images that cannot be aligned."""
    unknown = torch.tensor(torch.nan, dtype=torch.float64, device=device)
    return DenseAlignment(
        T_ba=unknown.expand(4, 4),
        reliable=unknown > 0,
        overlap=unknown,
        inliers=torch.zeros_like(unknown, dtype=torch.int64),
        inlier_ratio=unknown,
        correlation=unknown,
        photometric_rms=unknown,
        geometric_rms=unknown,
        information=unknown.expand(6, 6),
        observability=unknown,
    )


def _correlation(x: Tensor, y: Tensor) -> Tensor:
    """Pearson correlation; NaN if either input is constant."""
    x, y = x - x.mean(), y - y.mean()
    return (x * y).sum() / (x.norm() * y.norm())
