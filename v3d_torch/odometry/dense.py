"""Camera motion between two frames from all their pixels: for blur, low light and few corners, where features fail.

Brightness and inverse depth are two images that the same motion warps. Both differences are minimised together, coarse
to fine, with the weights of a t-distribution, after Kerl, Sturm and Cremers (Robust Odometry Estimation for RGB-D
Cameras, ICRA 2013; Dense Visual SLAM for RGB-D Cameras, IROS 2013). Inverse depth is linear over a plane, so that its
difference is a point's distance to the other view's plane in standard deviations of the sensor (point-to-plane).

Images stay as delivered: points of the reference are bent by the lens on their way into the current view, and the
gradients are unbent in the reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from kornia.filters import spatial_gradient
from pydantic import Field
from pypose import mat2SE3
from pypose.lietensor.operation import SE3_Adj
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, max_pool2d, pixel_unshuffle

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import Section
from v3d_torch.errors import ConfigError
from v3d_torch.levenberg import Minimum, levenberg_marquardt
from v3d_torch.lie import invert, rigid, se3_exp
from v3d_torch.odometry.refine import Measurements, reprojection


class DenseConfig(Section):
    """Camera motion from all pixels, where features fail."""

    halvings: tuple[int, ...] = (4, 2, 1)
    """How often the image is halved on each level, coarse to fine. A turn of 60 pixels from frame to frame is 4 on the
    coarsest. Full resolution takes half as long again, gains 0.1 mm on the demo and nothing on real images."""
    points: int = Field(5000, gt=0)
    """About so many pixels of a level take part, one of each cell: bounds the time. On the demo, twice as many gain
    0.03 mm."""
    iterations: int = Field(10, gt=0)
    """Most Levenberg-Marquardt steps on a level."""
    max_depth: float = Field(8.0, gt=0)
    """Depth beyond is taken for none, metres, as for features."""
    edge: float = Field(0.05, gt=0)
    """Neighbours whose depth differs by more than this share lie on two surfaces, as in the depth's re-estimation."""
    occlusion: float = Field(0.1, gt=0)
    """Where inverse depth differs by more than this share, something else is seen: it tells nothing of the motion."""
    freedom: float = Field(5.0, gt=0)
    """Degrees of freedom of the t-distribution (Kerl et al., ICRA 2013, who found it from residuals)."""
    inverse_depth_sigma: float = Field(0.003, gt=0)
    """Least standard deviation of inverse depth, 1/m: twice the sensor's (Khoshelham and Elberink, Sensors 2012)."""
    coarse_inverse_depth_sigma: float = Field(0.02, gt=0)
    """The same above the finest level, so that brightness leads there: depth is taken at another time than colour, and
    in a fast turn tells of another motion, which is an optimum of its own."""
    min_overlap: float = Field(0.3, gt=0, le=1)
    """Share of the reference's points that the current view must see."""
    min_inlier_share: float = Field(0.75, gt=0, le=1)
    """Share of those points, of the ones with depth, whose depth must agree."""
    min_correlation: float = Field(0.9, gt=0, le=1)
    """Least correlation of both views' brightness; unlike a residual it does not depend on light."""
    min_observability: float = Field(1e-3, gt=0, le=1)
    """Smallest over greatest eigenvalue of the information, translation measured in median depths: below, some motion
    is not seen, as along a wall without texture. Of 693 pairs of neighbouring frames of TUM's fr1_rpy, 2 lie below."""


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
    inlier_share: float
    correlation: float
    photometric_rms: float
    geometric_rms: float
    information: Tensor
    observability: float


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
        """The lens of an image that was halved so often.

        Raises:
            ConfigError: nothing is left of the image.
        """
        size = 2**halvings
        if min(camera.width, camera.height) < 2 * size:
            raise ConfigError(
                f"dense.halvings asks for {halvings}, which leaves nothing of {camera.width}x{camera.height} pixels;"
                " give fewer."
            )
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
    config: DenseConfig

    @cached_property
    def anchors(self) -> Anchors:
        """The pixel of strongest gradient of every cell, where there is depth.

        Around the solution the current view shows what the reference shows, so that the slopes are the reference's own
        and are not computed again in each step (inverse composition; Baker and Matthews, IJCV 2004).
        """
        gradient = spatial_gradient(self.channels[None])[0]  # Sobel; 2 x (x, y) x H x W
        inverse = self.channels[1]
        same_surface = (2 * gradient[1].abs() <= self.config.edge * inverse).all(dim=0)
        strength = gradient[0].square().sum(dim=0).where(inverse.isfinite(), torch.nan).nan_to_num(nan=-1.0)
        cell = max(1, round((inverse.numel() / self.config.points) ** 0.5))
        strongest, index = max_pool2d(strength[None], cell, ceil_mode=True, return_indices=True)
        index = index[strongest >= 0]

        values = self.channels.flatten(1)[:, index]
        points = self.lens.camera.rays.flatten(0, 1)[index] / values[1, :, None]
        one = torch.ones_like(values[1])
        unit = Measurements(uv=one[:, None].expand(-1, 2), inverse_depth=one, pixel_sigma=one, inverse_depth_sigma=1.0)
        _, moved = reprojection(points, unit, self.lens.camera)  # how (u, v, 1/z) move, M x 3 x 6
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
        self, grey: Tensor, depth: Tensor, static: Tensor, lenses: dict[int, Lens], config: DenseConfig
    ) -> None:
        static = static[None] & grey.isfinite()
        inverse = torch.where(static & (depth > 0) & (depth <= config.max_depth), 1 / depth, 0.0)
        grey = grey.where(static, 0.0)
        self.levels: dict[int, Level] = {}
        for halvings in range(max(lenses) + 1):
            if halvings:
                grey, static = avg_pool2d(grey, 2), avg_pool2d(static.to(torch.float32), 2) == 1
                inverse = _halve(inverse, config.edge)
            if halvings in lenses:
                channels = torch.cat([grey.where(static, torch.nan), inverse.where(static & (inverse > 0), torch.nan)])
                self.levels[halvings] = Level(channels, lenses[halvings], config)


def _halve(inverse: Tensor, edge: float) -> Tensor:
    """Inverse depth at half the size: the mean on the nearest surface among four pixels, 0 where none is measured."""
    height, width = inverse.shape[-2:]
    four = pixel_unshuffle(inverse[:, : height // 2 * 2, : width // 2 * 2], 2)
    near = four > (1 - edge) * four.amax(dim=0, keepdim=True)
    return (four * near).sum(dim=0, keepdim=True) / near.sum(dim=0, keepdim=True).clamp(min=1)


State = tuple[Tensor, Tensor]  # T_ba (4, 4); gain and bias from the reference's brightness to the current one's (2,)
System = tuple[Tensor, Tensor]  # J^T W J (8, 8) and J^T W r (8,) for xi in T_ba @ exp(xi), gain, bias


@dataclass(frozen=True)
class Comparison:
    """Reference against current view.

    Attributes:
        residuals: current minus expected brightness and inverse depth, float64, shape :math:`(2, M)`.
        compared: where both views show one surface, bool, shape :math:`(2, M)`.
        hidden: points where the current view shows another surface, bool, shape :math:`(M,)`.
        seen: points that lie in the current view on what stands still, bool, shape :math:`(M,)`.
    """

    residuals: Tensor
    compared: Tensor
    hidden: Tensor
    seen: Tensor


class Problem:
    """The least-squares problem of one level. Noise and Jacobian are those at its start.

    Args:
        reference: gives the points.
        current: where they are looked up.
        start: motion, gain and bias.
        inverse_depth_sigma: least standard deviation of inverse depth, 1/m.
        config: what hides, and the tails of the noise.
    """

    _LEAST = 50  # comparisons: from fewer, eight unknowns are noise
    _BRIGHTNESS_SIGMA = 1e-3  # least standard deviation: a quarter of a step of 8 bits
    _NEAREST = 0.1  # metres: no camera sees nearer, and 1/z stays finite
    # Of a pixel's variance, Sobel's gradient has 12/64; the scale of a t-distribution is 3/4 of the variance it fits.
    _GRADIENT_NOISE = 0.3

    def __init__(
        self, reference: Level, current: Level, start: State, inverse_depth_sigma: float, config: DenseConfig
    ) -> None:
        self.anchors, self._current, self._config = reference.anchors, current, config
        first = self.compare(start)
        self._sigma = torch.tensor([[self._BRIGHTNESS_SIGMA], [inverse_depth_sigma]], dtype=torch.float64)
        for sigma, residuals, compared in zip(self._sigma, first.residuals, first.compared, strict=True):
            if compared.any():
                sigma.clamp_(min=student_t_scale(residuals[compared].square(), config.freedom))
        by_light = torch.zeros(2, len(self.anchors.points), 2, dtype=torch.float64)
        by_light[0] = -torch.stack([self.anchors.values[0], torch.ones_like(self.anchors.values[0])], dim=-1)
        gains = torch.stack([start[1][0], torch.ones_like(start[1][0])])
        self._jacobian = torch.cat([gains[:, None, None] * self.anchors.slopes, by_light], dim=-1).flatten(0, 1)

    def compare(self, state: State) -> Comparison:
        """Look up the reference's points in the current view."""
        T_ba, (gain, bias) = state[0].to(torch.float32), state[1].to(torch.float32)
        camera = self._current.lens.camera
        points = self.anchors.points @ T_ba[:3, :3].T + T_ba[:3, 3]
        in_front = points[:, 2] > self._NEAREST
        pixels = camera.distort(camera.project(points.where(in_front[:, None], 1.0))).to(torch.float32)
        last = torch.tensor([camera.width - 1, camera.height - 1])
        in_view = in_front & ((pixels >= 0) & (pixels <= last)).all(dim=1)
        there = grid_sample(self._current.channels[None], (2 * pixels / last - 1)[None, None], align_corners=True)
        inverse = 1 / points[:, 2]
        residuals = there[0, :, 0] - torch.stack([gain * self.anchors.values[0] + bias, inverse])
        known = residuals.isfinite() & in_view
        limit = self._config.occlusion * inverse
        hidden = known[1] & (residuals[1].abs() > limit)
        residuals[1] = residuals[1].clamp(-limit, limit)
        return Comparison(
            residuals=residuals.where(known, 0.0).to(torch.float64),
            compared=known & self.anchors.usable & ~hidden,
            hidden=hidden,
            seen=known[0],
        )

    def linearise(self, state: State) -> tuple[float, System]:
        """Mean robust cost, infinite where there is too little to compare, and normal equations."""
        now = self.compare(state)
        if int(now.compared.sum()) < self._LEAST:
            return torch.inf, (torch.zeros(8, 8, dtype=torch.float64), torch.zeros(8, dtype=torch.float64))
        costs, weights = student_t((now.residuals / self._sigma).square(), self._config.freedom)
        weights = (weights * now.compared / self._sigma.square()).flatten()
        weighted = (self._jacobian * weights[:, None]).T
        # A hidden point costs as much as one about to be: else a motion could gain by hiding what disagrees.
        counted = torch.stack([now.compared[0], now.compared[1] | now.hidden])
        return float(costs[counted].mean()), (weighted @ self._jacobian, weighted @ now.residuals.flatten())

    def information(self, system: System, lit: Tensor) -> Tensor:
        """What is known of ``xi``, gain and bias marginalised, (6, 6).

        Noise in gradients looks like texture: on stripes it would claim to know the motion along them. It has been
        measured, as it makes up the residuals, and is taken off. What remains may be indefinite.
        """
        H, _ = system
        flow = self.anchors.flow[lit].flatten(0, 1).to(torch.float64)
        by_light = H[:6, 6:] @ torch.linalg.pinv(H[6:, 6:], hermitian=True) @ H[6:, :6]
        return H[:6, :6] - by_light - self._GRADIENT_NOISE * (flow.T @ flow)


def _step(state: State, system: System, damping: float) -> State:
    H, gradient = system
    # The slopes are the reference's, not quite the current view's: with less damping a step that failed fails again.
    diagonal = 1e3 * damping * H.diagonal() + 1e-9  # solvable even where nothing is seen
    step = -torch.linalg.solve(H + diagonal.diag(), gradient)
    return state[0] @ se3_exp(step[:6]), state[1] + step[6:]


def student_t(squared: Tensor, freedom: float) -> tuple[Tensor, Tensor]:
    """The t-distribution as a robust kernel: its long tails expect outliers (Kerl et al., ICRA 2013).

    Args:
        squared: squared errors s in sigmas, any shape.
        freedom: degrees of freedom.

    Returns:
        costs rho(s), twice the negative log-likelihood, and weights d rho / d s, both as ``squared``.
    """
    return (freedom + 1) * torch.log1p(squared / freedom), (freedom + 1) / (freedom + squared)


def student_t_scale(squared: Tensor, freedom: float) -> Tensor:
    """The sigma with which a t-distribution fits errors best, by fixed-point iteration (Kerl et al., ICRA 2013).

    Args:
        squared: squared errors, shape :math:`(M,)`, at least one.
        freedom: degrees of freedom.
    """
    variance = squared.mean()
    for _ in range(10):
        variance = (student_t(squared / variance.clamp(min=1e-12), freedom)[1] * squared).mean()
    return variance.sqrt()


class DenseAligner:
    """Finds the motion between two views from what stands still in both.

    Args:
        config: levels, noise, and what is trusted.
        camera: of both views, with its lens.

    Raises:
        ConfigError: the camera's image is too small for the levels.
    """

    _LEAST_CONTRAST = 2e-3  # standard deviation of a coarse image that shows anything: half a step of 8 bits
    _AGREEMENT = 5.0  # least sigmas of inverse depth within which depth agrees: time lag and edges make long tails

    def __init__(self, config: DenseConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._lenses = {halvings: Lens.of(camera, halvings) for halvings in config.halvings}

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
        *_, finest = self._config.halvings
        light = self._light(a, b)
        if light is None or not T_ba.isfinite().all() or not len(a.levels[finest].anchors.points):
            return None
        state = (T_ba, light)
        for halvings in self._config.halvings:
            sigma = self._config.inverse_depth_sigma if halvings == finest else self._config.coarse_inverse_depth_sigma
            problem = Problem(a.levels[halvings], b.levels[halvings], state, sigma, self._config)
            # Convergence is quadratic: after a step that gained a thousandth nothing worth a step is left.
            found = levenberg_marquardt(state, problem.linearise, _step, self._config.iterations, tolerance=1e-3)
            state = found.state
        return self._summarise(problem, found)

    def _light(self, a: DenseView, b: DenseView) -> Tensor | None:
        """First gain and bias, (2,), from the contrast and mean of both images; None where either shows nothing."""
        coarsest = self._config.halvings[0]
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
            inlier_share=float(agree.sum() / (now.compared[1] | now.hidden).sum()),
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
            and found.inlier_share >= self._config.min_inlier_share
            and found.correlation >= self._config.min_correlation
            and found.observability >= self._config.min_observability
        )


def _correlation(x: Tensor, y: Tensor) -> float:
    """Pearson's; not a number where either is constant."""
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x.norm() * y.norm()))
