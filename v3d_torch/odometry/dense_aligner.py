"""Camera motion between two frames from all their pixels: for blur, low light and few corners, where features fail.

Brightness and inverse depth are two images that the same motion warps. Both differences are minimised together, coarse
to fine, with the weights of a t-distribution, after Kerl, Sturm and Cremers (Robust Odometry Estimation for RGB-D
Cameras, ICRA 2013; Dense Visual SLAM for RGB-D Cameras, IROS 2013). Inverse depth is linear over a plane, so that its
difference is a point's distance to the other view's plane in standard deviations of the sensor (point-to-plane).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pypose import mat2SE3
from pypose.lietensor.operation import SE3_Adj
from torch import Tensor

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, rigid
from v3d_torch.odometry.dense_problem import Problem, State, System, step
from v3d_torch.odometry.dense_view import DenseView, Lens
from v3d_torch.optim.levenberg_marquardt import Minimum, levenberg_marquardt


@dataclass(frozen=True)
class DenseAlignment:
    """A motion between two views, and what supports it.

    Attributes:
        T_ba: maps points of the reference's camera a to the current camera b, float64, shape :math:`(4, 4)`.
        overlap: share of the reference's points that the current view sees on what stands still.
        inliers: points whose depth agrees in both views.
        inlier_share: of the points whose depth both views measure.
        correlation: of both views' brightness at the same points, from -1 to 1.
        photometric_rms: difference of brightness after gain and bias, in units of the current image.
        geometric_rms: difference of inverse depth, 1/m.
        information: inverse covariance of the left perturbation ``exp(xi) @ T_ba``, ``xi = [translation, rotation]``
            in metres and radians, gain and bias marginalised, float64, shape :math:`(6, 6)`. Pixels count as
            independent, which neighbours are not: right in shape, too sure in scale.
        observability: its smallest over its greatest eigenvalue, translation measured in median depths.
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
    """Finds the motion between two views from what stands still in both.

    Args:
        config: levels, noise, and what is trusted.
        camera: of both views, with its lens. Levels of which its image leaves less than 2 pixels are left out.
    """

    _LEAST_CONTRAST = 2e-3  # standard deviation of a coarse image that shows anything: half a step of 8 bits
    _AGREEMENT = 5.0  # least sigmas of inverse depth within which depth agrees: time lag and edges make long tails

    def __init__(self, config: DenseOdometryConfig, camera: PinholeCamera) -> None:
        size = min(camera.width, camera.height)
        self._config = config
        self._halvings = tuple(halvings for halvings in config.halvings if size >= 2 << halvings) or (0,)
        self._lenses = {halvings: Lens.of(camera, halvings) for halvings in self._halvings}

    def view(self, grey: Tensor, depth: Tensor, static: Tensor) -> DenseView:
        """Prepare a frame; see `DenseView`."""
        return DenseView(grey, depth, static, self._lenses, self._config)

    @torch.no_grad()
    def __call__(self, a: DenseView, b: DenseView, T_ba: Tensor) -> DenseAlignment | None:
        """Motion from a reference to the current view.

        Args:
            a: reference; its points with depth take part.
            b: current view.
            T_ba: prediction, float64, shape :math:`(4, 4)`.

        Returns:
            None when the motion is not to be trusted: there is nothing to see, too little of the reference is in view,
            a direction of motion cannot be observed, or the views disagree at the optimum.
        """
        found = self._align(a, b, T_ba)
        return found if found is not None and self._trusts(found) else None

    def _align(self, a: DenseView, b: DenseView, T_ba: Tensor) -> DenseAlignment | None:
        *_, finest = self._halvings
        light = self._light(a, b)
        if light is None or not T_ba.isfinite().all() or not len(a.levels[finest].anchors.points):
            return None
        state = (T_ba, light)
        for halvings in self._halvings:
            sigma = self._config.inverse_depth_sigma if halvings == finest else self._config.coarse_inverse_depth_sigma
            problem = Problem(a.levels[halvings], b.levels[halvings], state, sigma, self._config)
            # Convergence is quadratic: after a step that gained a thousandth nothing worth a step is left.
            found = levenberg_marquardt(state, problem.linearise, step, self._config.iterations, tolerance=1e-3)
            state = found.state
        return self._summarise(problem, found)

    def _light(self, a: DenseView, b: DenseView) -> Tensor | None:
        """First gain and bias, (2,), from the contrast and mean of both images; None where either shows nothing."""
        coarsest = self._halvings[0]
        greys = [grey[grey.isfinite()].to(torch.float64) for grey in (v.levels[coarsest].channels[0] for v in (a, b))]
        mean_a, mean_b = (grey.mean() for grey in greys)
        contrast_a, contrast_b = ((grey - grey.mean()).square().mean().sqrt() for grey in greys)
        if not min(contrast_a, contrast_b) > self._LEAST_CONTRAST:  # not a number where nothing stands still
            return None
        gain = contrast_b / contrast_a
        return torch.stack([gain, mean_b - gain * mean_a])

    def _summarise(self, problem: Problem, found: Minimum[State, System]) -> DenseAlignment:
        T_ba, (gain, _) = rigid(found.state[0]), found.state[1]
        now = problem.compare(found.state)
        (brightness, inverse), lit = problem.anchors.values.to(torch.float64), now.compared[0]
        agree = now.compared[1] & (now.residuals[1].abs() <= self._AGREEMENT * self._config.inverse_depth_sigma)
        rms = [float(r[c].square().mean().sqrt()) for r, c in zip(now.residuals, now.compared, strict=True)]
        information = problem.information(found.system, lit)
        by_depth = torch.ones(6, dtype=torch.float64)
        by_depth[:3] = 1 / inverse.median()
        eigenvalues = torch.linalg.eigvalsh(by_depth[:, None] * information * by_depth)
        to_right = SE3_Adj(mat2SE3(invert(T_ba)).tensor())  # exp(xi) T = T exp(Ad(T^-1) xi)
        return DenseAlignment(
            T_ba=T_ba,
            overlap=float(now.seen.to(torch.float64).mean()),
            inliers=int(agree.sum()),
            inlier_ratio=float(agree.sum() / (now.compared[1] | now.hidden).sum()),
            correlation=_correlation(brightness[lit], (gain * brightness + now.residuals[0])[lit]),
            photometric_rms=rms[0],
            geometric_rms=rms[1],
            information=to_right.mT @ information @ to_right,
            observability=float(eigenvalues[0] / eigenvalues[-1]),
        )

    def _trusts(self, found: DenseAlignment) -> bool:
        """Whether nothing speaks against it; what is not a number does."""
        return (
            found.overlap >= self._config.min_overlap
            and found.inlier_ratio >= self._config.min_inlier_share
            and found.correlation >= self._config.min_correlation
            and found.observability >= self._config.min_observability
        )


def _correlation(x: Tensor, y: Tensor) -> float:
    """Pearson's; not a number where either is constant."""
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x.norm() * y.norm()))
