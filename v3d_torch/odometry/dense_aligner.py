"""Dense RGB-D alignment: camera motion from all pixels, for blur, low light and few corners, where features fail.

Brightness and inverse depth are two images that the same motion warps. Both residuals are minimised together, coarse to
fine, with the weights of a t-distribution (Kerl, Sturm and Cremers: Robust Odometry Estimation for RGB-D Cameras, ICRA
2013; Dense Visual SLAM for RGB-D Cameras, IROS 2013). The inverse depth of a plane is linear in the image, so the
whitened residual is a point-to-plane distance in units of the sensor noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pypose import mat2SE3
from pypose.lietensor.operation import SE3_Adj
from torch import Tensor

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, orthonormalise
from v3d_torch.odometry.dense_problem import AlignmentProblem, State, System, step
from v3d_torch.odometry.dense_view import DenseView, LevelCamera
from v3d_torch.optim.levenberg_marquardt import OptimisationResult, levenberg_marquardt

_COARSE_INVERSE_DEPTH_SIGMA = 0.02
"""Minimum standard deviation of inverse depth above the finest level, 1/m. It gives brightness more weight there: depth
is measured at another time than colour, so in a fast turn its residuals have their optimum at another motion."""

_MIN_INLIER_RATIO = 0.75
"""Minimum fraction of the points with depth in both views whose depth agrees."""

_MIN_CORRELATION = 0.9
"""Minimum correlation of the brightness of both views. Unlike a residual, it does not depend on exposure."""

_TOLERANCE = 1e-3
"""Relative change of the cost at convergence. Gauss-Newton converges quadratically: the next step gains far less."""


@dataclass(frozen=True)
class DenseAlignment:
    """Motion between two views found by dense alignment, with measures of its quality.

    Attributes:
        T_ba: Maps points from the reference's camera a to the current camera b, float64, shape :math:`(4, 4)`.
        overlap: Fraction of the reference points that lie on static pixels of the current view.
        inliers: Number of points whose depth agrees in both views.
        inlier_ratio: Inliers as a fraction of the points with depth in both views.
        correlation: Correlation of the brightness of both views at the same points, from -1 to 1.
        photometric_rms: Root mean square of the brightness residuals after gain and bias, in brightness of the current
            image.
        geometric_rms: Root mean square of the inverse-depth residuals, 1/m.
        information: Information matrix (inverse covariance) of the left perturbation ``exp(xi) @ T_ba``,
            ``xi = [translation, rotation]``, metres and radians, with gain and bias marginalised, float64, shape
            :math:`(6, 6)`. It treats pixels as independent, so its scale is too large.
        observability: Ratio of the smallest to the largest eigenvalue of the information, with translation in units of
            the median depth.
    """

    T_ba: Tensor
    overlap: float
    inliers: int
    inlier_ratio: float
    correlation: float
    photometric_rms: float
    geometric_rms: float
    information: Tensor
    observability: float


class DenseAligner:
    """Estimates the motion between two views from their static pixels.

    Args:
        config: Pyramid levels, noise, acceptance thresholds.
        camera: Camera of both views, with lens distortion. Levels with fewer than 2 rows or columns are skipped.
    """

    _MIN_CONTRAST = 2e-3
    """Minimum standard deviation of brightness on the coarsest level: half an 8-bit step."""

    _MAX_DEPTH_SIGMAS = 5.0
    """Depth agrees up to this many standard deviations of inverse depth: colour-depth delay and depth edges make the
    residuals heavy-tailed."""

    def __init__(self, config: DenseOdometryConfig, camera: PinholeCamera) -> None:
        size = min(camera.width, camera.height)
        self._config = config
        self._halvings = tuple(halvings for halvings in config.halvings if size >= 2 << halvings) or (0,)
        self._cameras = {halvings: LevelCamera.from_camera(camera, halvings) for halvings in self._halvings}

    def view(self, grey: Tensor, depth: Tensor, static: Tensor) -> DenseView:
        """Prepare a frame for alignment; see `DenseView`."""
        return DenseView(grey, depth, static, self._cameras, self._config)

    @torch.no_grad()
    def __call__(self, a: DenseView, b: DenseView, T_ba: Tensor) -> DenseAlignment | None:
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
        return alignment if alignment is not None and self._is_reliable(alignment) else None

    def _align(self, a: DenseView, b: DenseView, T_ba: Tensor) -> DenseAlignment | None:
        *_, finest = self._halvings
        gain_and_bias = self._initial_gain_and_bias(a, b)
        if gain_and_bias is None or not T_ba.isfinite().all() or not len(a.levels[finest].reference_points.points):
            return None
        state = (T_ba, gain_and_bias)
        for halvings in self._halvings:
            sigma = self._config.inverse_depth_sigma if halvings == finest else _COARSE_INVERSE_DEPTH_SIGMA
            problem = AlignmentProblem(a.levels[halvings], b.levels[halvings], state, sigma, self._config)
            result = levenberg_marquardt(state, problem.linearise, step, self._config.iterations, tolerance=_TOLERANCE)
            state = result.state
        return self._summarise(problem, result)

    def _initial_gain_and_bias(self, a: DenseView, b: DenseView) -> Tensor | None:
        """Gain and bias from the contrast and mean of both images, shape (2,); None if either has no contrast."""
        coarsest = self._halvings[0]
        greys = [view.levels[coarsest].channels[0] for view in (a, b)]
        greys = [grey[grey.isfinite()].to(torch.float64) for grey in greys]
        mean_a, mean_b = (grey.mean() for grey in greys)
        contrast_a, contrast_b = ((grey - grey.mean()).square().mean().sqrt() for grey in greys)
        if not min(contrast_a, contrast_b) > self._MIN_CONTRAST:  # also true for NaN, if no pixel is static
            return None
        gain = contrast_b / contrast_a
        return torch.stack([gain, mean_b - gain * mean_a])

    def _summarise(self, problem: AlignmentProblem, result: OptimisationResult[State, System]) -> DenseAlignment:
        T_ba, (gain, _) = orthonormalise(result.state[0]), result.state[1]
        residuals = problem.residuals(result.state)
        (brightness, inverse_depth), valid_brightness = problem.reference.values.to(torch.float64), residuals.valid[0]
        max_difference = self._MAX_DEPTH_SIGMAS * self._config.inverse_depth_sigma
        inliers = residuals.valid[1] & (residuals.values[1].abs() <= max_difference)
        rms = [float(r[v].square().mean().sqrt()) for r, v in zip(residuals.values, residuals.valid, strict=True)]
        information = problem.information(result.system, valid_brightness)
        scale = torch.ones(6, dtype=torch.float64)
        scale[:3] = 1 / inverse_depth.median()
        eigenvalues = torch.linalg.eigvalsh(scale[:, None] * information * scale)
        left_to_right = SE3_Adj(mat2SE3(invert(T_ba)).tensor())  # exp(xi) T = T exp(Ad(T^-1) xi)
        return DenseAlignment(
            T_ba=T_ba,
            overlap=float(residuals.in_view.to(torch.float64).mean()),
            inliers=int(inliers.sum()),
            inlier_ratio=float(inliers.sum() / (residuals.valid[1] | residuals.occluded).sum()),
            correlation=_correlation(
                brightness[valid_brightness], (gain * brightness + residuals.values[0])[valid_brightness]
            ),
            photometric_rms=rms[0],
            geometric_rms=rms[1],
            information=left_to_right.mT @ information @ left_to_right,
            observability=float(eigenvalues[0] / eigenvalues[-1]),
        )

    def _is_reliable(self, alignment: DenseAlignment) -> bool:
        """Check the quality of an alignment; NaN counts as bad."""
        return (
            alignment.overlap >= self._config.min_overlap
            and alignment.inlier_ratio >= _MIN_INLIER_RATIO
            and alignment.correlation >= _MIN_CORRELATION
            and alignment.observability >= self._config.min_observability
        )


def _correlation(x: Tensor, y: Tensor) -> float:
    """Pearson correlation; NaN if either input is constant."""
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x.norm() * y.norm()))
