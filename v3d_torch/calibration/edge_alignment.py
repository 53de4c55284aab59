r"""Registration and delay of the depth image, from its occlusion boundaries and the edges of the colour image.

Most occlusion boundaries are edges of the colour image, too. If the depth image is not registered to the colour image,
its boundaries have a constant shift; if it was taken at another time, they are shifted by the image motion in between.
Shift and delay are estimated by maximising the number of boundaries on edges (cf. Levinson and Thrun, Automatic Online
Calibration of Cameras and Lasers, RSS 2013). A single view has many other edges, but their positions differ between
views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from v3d_torch.calibration.view_edges import ViewEdges, find_edges, view_pixels
from v3d_torch.geometry.se3 import invert, transform_points
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.optim.jackknife import jackknife_covariance
from v3d_torch.types import Trajectory

_MIN_BOUNDARIES = 100
"""Minimum number of boundaries of a view; fewer can fit somewhere by chance."""

_SHIFTS = 48
"""Maximum shift of the coarse search along both axes, frame pixels of 640 columns."""

_DELAYS = torch.arange(-12, 13, dtype=torch.float64) / 100
"""Delays of the coarse search, seconds."""

_REACH = 64
"""Maximum displacement by shift and delay together, frame pixels of 640 columns; boundaries with a larger displacement
do not count in the coarse search."""

_STEP = 2.0
"""Step of the finite differences by the shift, frame pixels: the width of the blurred edges."""

_DELAY_STEPS = (0.001, 0.02)
"""Range of the step of the finite differences by the delay, seconds; in this time most images move by about the step of
the shift."""

_MAX_NEWTON_STEPS = 20
_CONVERGED = 0.02
"""Size of the last Newton step, as a fraction of the steps of the finite differences."""

_MIN_RATIO = 1.5
"""Minimum ratio of a significantly better score to the other score: edges that are not boundaries give smaller
ratios."""

_MIN_T = 3.0
"""Minimum t-statistic of the difference between two scores, over views and over parts of the image."""

_PARTS = 4
"""Number of parts of the image in each direction."""

_MIN_CLUSTERS = 4
"""Minimum number of views or of parts of the image for a test."""

MAX_REGISTERED_SHIFT = 0.01
"""Maximum shift of depth that is registered to colour, relative to the width of the image: 6 pixels of 640, three times
the error of the registration by a driver."""

MIN_VIEWS = 5
"""Minimum number of views for an estimate."""


@dataclass(frozen=True)
class Misalignment:
    """Shift and delay that maximise the number of boundaries on edges.

    Attributes:
        values: Shift of the colour image relative to the depth image along u and v (frame pixels), and delay of the
            depth image in addition to the assumed delay (seconds), float64, shape :math:`(3,)`.
        covariance: Covariance of the values, by the jackknife over views, shape :math:`(3, 3)`.
        blocks: Number of blocks of the jackknife.
    """

    values: Tensor
    covariance: Tensor
    blocks: int

    @property
    def sigma(self) -> Tensor:
        """Standard deviations of the values, shape :math:`(3,)`."""
        return self.covariance.diagonal().clamp(min=0).sqrt()


class EdgeAlignment:
    """Search for the shift and the delay of the depth images of a run.

    Args:
        views: Static views of the keyframes. Views of an earlier run are ignored.
        trajectory: Poses of all frames.
        depth_delay: Delay of all depth images in addition to that of their timestamps, seconds.
        max_views: Maximum number of views, evenly spread over the run; None for all.
    """

    def __init__(
        self, views: StaticViews, trajectory: Trajectory, depth_delay: float, max_views: int | None = None
    ) -> None:
        own = views.own
        step = 1 if max_views is None else max(-(-len(own) // max_views), 1)
        pairs = [(view, find_edges(view.colour, view.depth, views.stride)) for view in own[::step]]
        pairs = [(view, edges) for view, edges in pairs if len(edges.axis) >= _MIN_BOUNDARIES]
        self._camera, self._stride, self._trajectory = views.camera, views.stride, trajectory
        self._edges = [edges for _, edges in pairs]
        self._stamp = torch.tensor([view.keyframe.stamp for view, _ in pairs], dtype=torch.float64)
        delays = torch.tensor([view.depth_delay + depth_delay for view, _ in pairs], dtype=torch.float64)
        self._depth_stamp = self._stamp + delays
        if not pairs:
            return
        self._T_cw = invert(trajectory.poses_at(self._stamp))
        self._pixel, depth, self._axis = (
            torch.cat([getattr(edges, name) for edges in self._edges]) for name in ("pixel", "depth", "axis")
        )
        counts = [len(edges.axis) for edges in self._edges]
        self._points = views.camera.back_project(self._pixel, depth).split(counts)  # of each view
        self._view = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
        self._gradients = torch.stack([edges.gradients for edges in self._edges])  # (K, 2, h, w)
        self._first_pixel = (2 * self._view + self._axis) * self._gradients[0, 0].numel()  # in all gradients, flat
        longest = _DELAY_STEPS[1]
        motion = (self._at_time_of_colour(longest) - self._at_time_of_colour(0.0)).norm(dim=1).median()
        delay_step = longest * _STEP / max(float(motion) * views.stride, _STEP)
        self._steps = torch.tensor([_STEP, _STEP, max(delay_step, _DELAY_STEPS[0])], dtype=torch.float64)

    def __len__(self) -> int:
        """Number of views with boundaries."""
        return len(self._edges)

    def search(self, free: Sequence[int] = (0, 1, 2)) -> Tensor:
        """Find the best shift and delay on a coarse grid, as in `Misalignment`.

        Args:
            free: Indices of the values that can differ from 0.
        """
        delays, shifts_v, shifts_u = (
            axis if index in free else torch.zeros(1, dtype=axis.dtype)
            for index, axis in zip((2, 1, 0), self._grid, strict=True)
        )
        total = self._grid_scores
        for dimension, (axis, used) in enumerate(zip(self._grid, (delays, shifts_v, shifts_u), strict=True)):
            if len(used) == 1:
                total = total.narrow(dimension, int((axis == 0).nonzero()), 1)
        t, v, u = np.unravel_index(int(total.argmax()), total.shape)
        return torch.stack([shifts_u[u] * self._stride, shifts_v[v] * self._stride, delays[t]]).to(torch.float64)

    @property
    def _grid(self) -> tuple[Tensor, Tensor, Tensor]:
        """Delays, shifts along v and shifts along u of the coarse search; seconds and view pixels."""
        longest = view_pixels(_SHIFTS, self._camera.width, self._stride)
        shifts = torch.arange(-longest, longest + 1)
        return _DELAYS, shifts, shifts

    @cached_property
    def _grid_scores(self) -> Tensor:
        """Approximate total score at each delay, shift along v and shift along u, (T, S, S)."""
        reach, shifts = view_pixels(_REACH, self._camera.width, self._stride), self._grid[1]
        maps = torch.stack([_correlation(edges, reach) for edges in self._edges])
        maps = pad(maps, (1, 1, 1, 1))  # beyond the maximum displacement, use the mean, 0
        motion = torch.stack([self._mean_motion(float(delay)) for delay in _DELAYS])  # (T, K, 2)
        index = (motion[..., None] + shifts).round().long().clamp(-reach - 1, reach + 1) + reach + 1
        view = torch.arange(len(maps))[:, None, None]
        # One delay at a time, because all together need gigabytes for large frames.
        return torch.stack([maps[view, v[..., None], u[:, None]].sum(dim=0) for u, v in index.transpose(1, 2)])

    def refine(self, start: Tensor, free: Sequence[int] = (0, 1, 2)) -> Misalignment:
        """Find the local maximum of the scores by Newton steps.

        Args:
            start: Initial values, as in `Misalignment`.
            free: Indices of the values that change.
        """
        values, index = start.clone(), torch.tensor(free)
        gradient, hessian = self._derivatives(values, index)
        score = self.total_score(values)
        for _ in range(_MAX_NEWTON_STEPS):
            step = _ascent_step(gradient.sum(dim=0), hessian.sum(dim=0))
            while step.abs().max() > _CONVERGED:
                moved = values.index_add(0, index, step * self._steps[index])
                if (new := self.total_score(moved)) > score:
                    break
                step = step / 2
            else:
                break
            values, score = moved, new
            gradient, hessian = self._derivatives(values, index)
        jackknife = jackknife_covariance(-gradient, -hessian)
        covariance, units = torch.zeros(3, 3, dtype=torch.float64), self._steps[index]
        covariance[index[:, None], index] = jackknife.covariance * units[:, None] * units
        return Misalignment(values, covariance, jackknife.blocks)

    def total_score(self, values: Tensor) -> float:
        """Sum of the normalised gradients at all boundaries, moved by a shift and a delay as in `Misalignment`."""
        return float(self._scores(values).sum())

    def is_better(self, values: Tensor, other: Tensor) -> bool:
        """Check whether significantly more boundaries lie on edges with some values than with others.

        Edges of one object can fit by chance in all views that show it, and edges of one view in all parts of the
        image. Therefore two t-tests must be significant, one with views and one with parts of the image as clusters.
        Consecutive views show the same objects, so that they are not independent: both halves of the run must agree.

        Args:
            values: Values that should be better, as in `Misalignment`.
            other: Values to compare with.
        """
        score, compared = self._scores(values), self._scores(other)
        if score.sum() < _MIN_RATIO * compared.sum():
            return False
        gains = score - compared
        if not bool((torch.bincount(2 * self._view // len(self), weights=gains) > 0).all()):
            return False
        height, width = self._gradients.shape[2:]
        cell = (self._pixel * _PARTS / torch.tensor([width, height])).long().clamp(0, _PARTS - 1)
        clusters = self._view, cell[:, 1] * _PARTS + cell[:, 0]
        return all(_t_statistic(gains, cluster) > _MIN_T for cluster in clusters)

    def _scores(self, values: Tensor) -> Tensor:
        """Normalised gradient at each boundary moved by the values, (E,)."""
        return self._gradients_at(self._at_time_of_colour(float(values[2])) + values[:2] / self._stride)

    def _gradients_at(self, moved: Tensor) -> Tensor:
        """Normalised gradient at the given pixel of each boundary, (E,)."""
        height, width = self._gradients.shape[2:]
        limit = torch.tensor([width - 1, height - 1], dtype=torch.float64)
        moved = moved.clamp(torch.zeros_like(limit), limit)
        corner = moved.long().clamp(max=limit.long() - 1)
        (a, b), (column, row) = (moved - corner).unbind(dim=1), corner.unbind(dim=1)
        flat, first = self._gradients.flatten(), self._first_pixel + row * width + column
        top, bottom = (
            (1 - a) * flat.index_select(0, first + k * width) + a * flat.index_select(0, first + k * width + 1)
            for k in (0, 1)
        )
        return (1 - b) * top + b * bottom

    def _at_time_of_colour(self, delay: float) -> Tensor:
        """Pixels of the boundaries at the time of the colour image, if depth has an additional delay, (E, 2)."""
        T_cd = self._T_cw @ self._trajectory.poses_at(self._depth_stamp + delay)
        moved = [transform_points(T, points) for points, T in zip(self._points, T_cd, strict=True)]
        return self._camera.project(torch.cat(moved))

    def _mean_motion(self, delay: float) -> Tensor:
        """Mean motion of the boundaries from depth to colour image, for each view, (K, 2)."""
        motion = self._at_time_of_colour(delay) - self._pixel
        return torch.stack([_group_means(component, self._view) for component in motion.T], dim=1)

    def _derivatives(self, values: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        """First (K, C) and second derivatives (K, C, C) of the score of each view, in units of the steps."""
        pixels_at = cache(self._at_time_of_colour)  # most of the moves below have the same delay

        def of_views(*moves: tuple[int, int]) -> Tensor:
            moved = values.clone()
            for i, sign in moves:
                moved[index[i]] += sign * self._steps[index[i]]
            scores = self._gradients_at(pixels_at(float(moved[2])) + moved[:2] / self._stride)
            return torch.bincount(self._view, weights=scores, minlength=len(self))

        count, centre = len(index), of_views()
        gradient = torch.zeros(len(self), count, dtype=torch.float64)
        hessian = torch.zeros(len(self), count, count, dtype=torch.float64)
        for i in range(count):
            ahead, behind = of_views((i, 1)), of_views((i, -1))
            gradient[:, i], hessian[:, i, i] = (ahead - behind) / 2, ahead - 2 * centre + behind
            for j in range(i):
                both = of_views((i, 1), (j, 1)) - 2 * centre + of_views((i, -1), (j, -1))
                hessian[:, i, j] = hessian[:, j, i] = (both - hessian[:, i, i] - hessian[:, j, j]) / 2
        return gradient, hessian


def _group_means(values: Tensor, group: Tensor) -> Tensor:
    """Means of values by group."""
    return torch.bincount(group, weights=values) / torch.bincount(group)


def _t_statistic(values: Tensor, cluster: Tensor) -> float:
    """Mean of values divided by its standard error, for values that are correlated within clusters.

    Liang and Zeger, Longitudinal data analysis using generalized linear models, Biometrika 1986. It is 0 if there are
    too few clusters for a test.
    """
    count = len(cluster.unique())
    if count < _MIN_CLUSTERS:
        return 0.0
    mean = values.mean()
    errors = torch.bincount(cluster, weights=values - mean)
    variance = count / (count - 1) * errors.square().sum() / len(values) ** 2
    return float(mean / variance.clamp(min=1e-24).sqrt())


def _ascent_step(gradient: Tensor, hessian: Tensor) -> Tensor:
    """Newton step to a maximum: uphill also where the curvature is positive, at most one unit along each axis."""
    curvature, directions = torch.linalg.eigh(hessian)
    step = directions @ (directions.T @ gradient / curvature.abs().clamp(min=1e-9))
    return step / max(float(step.abs().max()), 1.0)


def _correlation(edges: ViewEdges, reach: int) -> Tensor:
    """Sum of the gradients at all boundaries after they are moved by (v, u) in [-reach, reach], by FFT."""
    height, width = edges.gradients.shape[1:]
    size = (height + reach, width + reach)
    column, row = edges.pixel.long().unbind(dim=1)
    boundaries = torch.zeros_like(edges.gradients)
    boundaries[edges.axis, row, column] = 1.0
    spectra = [torch.fft.rfft2(each, s=size) for each in (boundaries, edges.gradients)]
    correlation = torch.fft.irfft2((spectra[0].conj() * spectra[1]).sum(dim=0), s=size)
    index = torch.arange(-reach, reach + 1)
    return correlation[index[:, None], index]
