"""Selection of the camera parameters that a recording determines.

A group of parameters is free only if the recording determines it, and all groups before it, within their tolerances.
Its estimates are accepted only if they differ significantly from the given values; otherwise the given values are kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.calibration.parameters import (
    DERIVATIVE_STEPS,
    PIXEL_TOLERANCE,
    ParameterGroup,
    get_values,
    groups_of,
    with_values,
)
from v3d_torch.calibration.problem import CostDerivatives, SelfCalibration
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.optim.jackknife import MAX_BLOCKS, Jackknife, jackknife_covariance, p_value

MAX_P_VALUE = 1e-3
"""Significance level: maximum probability of a difference by chance with which an estimate is accepted."""

_FOCAL_ERROR = 0.015
"""Relative standard deviation of focal lengths due to errors of the camera model: true lens distortion differs from its
model, the readout is not constant, depth has errors. It is that of recordings whose focal lengths are known."""

_CENTRE_ERROR = 0.005
"""Standard deviation of the principal point by the same causes, relative to the width of the image: that of published
principal points."""

_LONG_BLOCKS = MAX_BLOCKS // 2
"""Number of the longer blocks with which standard deviations are compared."""

_GRID = 9
"""Rows and columns of the pixels at which the effect of parameters is measured."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of one camera parameter.

    Attributes:
        name: Name of the parameter.
        given: Value of the given camera; None if it states none.
        value: Estimated value; NaN if there is none.
        sigma: Standard deviation of the estimate; infinite if there is none.
        accepted: True if the estimate replaces the given value.
        reason: Reason why the given value was kept; empty if it was replaced.
    """

    name: str
    given: float | None
    value: float
    sigma: float
    accepted: bool
    reason: str


NOT_DETERMINED, AGREES = "not determined by the recording", "agrees with the given value"
"""Reasons why given values are kept."""


def decide(name: str, given: float, value: float, sigma: float, blocks: int, tolerance: float) -> Estimate:
    """Decide whether the estimate of a single parameter replaces the given value.

    Args:
        name: Name of the parameter.
        given: Given value.
        value: Estimated value.
        sigma: Standard deviation of the estimate, by the jackknife.
        blocks: Number of its blocks.
        tolerance: Maximum accepted standard deviation.
    """
    if not sigma <= tolerance:
        return Estimate(name, given, value, sigma, accepted=False, reason=NOT_DETERMINED)
    difference = torch.tensor([value - given], dtype=torch.float64)
    variance = torch.tensor([[sigma**2]], dtype=torch.float64)
    if p_value(difference, variance, torch.zeros_like(variance), blocks) > MAX_P_VALUE:
        return Estimate(name, given, value, sigma, accepted=False, reason=AGREES)
    return Estimate(name, given, value, sigma, accepted=True, reason="")


@dataclass(frozen=True)
class _Fit:
    """Minimum of the cost for some free groups.

    Attributes:
        values: Value of each free parameter.
        covariance: Covariance of the free parameters, shape (C, C).
        blocks: Number of blocks of keyframes from which it comes.
        width: Width of the images, pixels.
    """

    values: dict[str, float]
    covariance: Tensor
    blocks: int
    width: int

    def sigma(self, name: str) -> float:
        """Standard deviation of a parameter."""
        index = list(self.values).index(name)
        return math.sqrt(max(float(self.covariance[index, index]), 0.0))

    def model_error(self, name: str) -> float:
        """Standard deviation of a parameter due to errors of the camera model."""
        if name in ("fx", "fy"):
            return _FOCAL_ERROR * self.values[name]
        return _CENTRE_ERROR * self.width if name in ("cx", "cy") else 0.0

    def total_sigma(self, name: str) -> float:
        """Standard deviation of a parameter due to noise and to errors of the camera model."""
        return math.hypot(self.sigma(name), self.model_error(name))

    def covariance_of(self, group: ParameterGroup) -> Tensor:
        """Covariance of the parameters of a group."""
        index = torch.tensor([list(self.values).index(name) for name in group.parameters])
        return self.covariance[index[:, None], index]


class ParameterSelection:
    """Fits the parameters of a camera group by group.

    Args:
        problem: Calibration problem.

    Attributes:
        free: Groups whose estimates are accepted.
        fit: Fit with these groups free.
        rejected: Estimates of the parameters whose given values are kept.
    """

    def __init__(self, problem: SelfCalibration) -> None:
        self._problem = problem
        self.free: list[ParameterGroup] = []
        self.fit = self._fit([])
        self.rejected: list[Estimate] = []
        for group in groups_of(problem.given):
            self._free_if_determined(group)
        while (confirmed := self._most_confirmed()) is not None:
            self._reject(confirmed, self.fit, AGREES)
            self.free.remove(confirmed)
            self.fit = self._fit(self.free)

    @property
    def estimates(self) -> list[Estimate]:
        """Estimates of all parameters, accepted estimates first."""
        accepted = [
            Estimate(name, self._given(name), value, self.fit.total_sigma(name), accepted=True, reason="")
            for name, value in self.fit.values.items()
        ]
        return accepted + self.rejected

    def _given(self, name: str) -> float | None:
        """Value of the given camera; None for an unknown readout."""
        unknown = name == "readout" and self._problem.given.readout is None
        return None if unknown else float(self._problem.given_values([name])[0])

    def _free_if_determined(self, group: ParameterGroup) -> None:
        fit = self._fit([*self.free, group])
        undetermined = [each for each in (*self.free, group) if not self._is_determined(each, fit)]
        if not undetermined:
            self.free.append(group)
            self.fit = fit
        elif group in undetermined:
            self._reject(group, fit, NOT_DETERMINED)
        else:
            others = ", ".join(name for each in undetermined for name in each.parameters)
            self._reject(group, fit, f"cannot be told apart from {others}")

    def _fit(self, groups: Sequence[ParameterGroup]) -> _Fit:
        names, width = [name for group in groups for name in group.parameters], self._problem.given.width
        if not names:
            return _Fit({}, torch.zeros(0, 0, dtype=torch.float64), 0, width)
        given = self._problem.given_values(names).tolist()
        start = [self.fit.values.get(name, value) for name, value in zip(names, given, strict=True)]
        values, at = self._problem.minimise(names, torch.tensor(start, dtype=torch.float64))
        return _Fit(dict(zip(names, values.tolist(), strict=True)), *covariance(self._problem, at), width)

    def _is_determined(self, group: ParameterGroup, fit: _Fit) -> bool:
        """Check whether a fit determines a group within its tolerance."""
        of_group = fit.covariance_of(group)
        if not of_group.isfinite().all():
            return False
        if group.tolerance is not None:
            return all(fit.sigma(name) <= group.tolerance for name in group.parameters)
        camera = self._problem.given
        effect = pixel_effect(camera, group.parameters, of_group)
        return effect <= PIXEL_TOLERANCE * camera.width

    def _most_confirmed(self) -> ParameterGroup | None:
        """Free group with the least significant difference from its given values; None if all are significant."""
        known = [group for group in self.free if self._given(group.parameters[0]) is not None]
        if not known:
            return None
        p_values = {group: self._p_value(group) for group in known}
        least = max(known, key=lambda group: p_values[group])
        return least if p_values[least] > MAX_P_VALUE else None

    def _p_value(self, group: ParameterGroup) -> float:
        """Probability that a difference from the given values as large as this one occurs by chance."""
        names = list(group.parameters)
        found = torch.tensor([self.fit.values[name] for name in names], dtype=torch.float64)
        difference = found - self._problem.given_values(names)
        model_error = torch.tensor([self.fit.model_error(name) for name in names], dtype=torch.float64)
        return p_value(difference, self.fit.covariance_of(group), model_error.square().diag(), self.fit.blocks)

    def _reject(self, group: ParameterGroup, fit: _Fit, reason: str) -> None:
        for name in group.parameters:
            self.rejected.append(
                Estimate(
                    name, self._given(name), fit.values[name], fit.total_sigma(name), accepted=False, reason=reason
                )
            )


def covariance(problem: SelfCalibration, at: CostDerivatives) -> Jackknife:
    """Covariance of the free parameters at the minimum.

    It is the jackknife covariance over blocks of keyframes, corrected for the degrees of freedom of poses and points.
    Variances are at least those of longer blocks, because errors can last longer than a block (cf. Flyvbjerg and
    Petersen, Error estimates on averages of correlated data, 1989), and at least those of the inverse of the normal
    matrix after marginalisation of poses and points by the Schur complement.

    Args:
        problem: Calibration problem.
        at: Map adjusted for the minimum.

    Returns:
        The covariance, shape :math:`(C, C)`, and the number of the shorter blocks.
    """
    freedom = problem.residual_count / max(problem.residual_count - problem.unknown_count, 1)
    found, longer = (jackknife_covariance(at.gradient, at.hessian, blocks) for blocks in (MAX_BLOCKS, _LONG_BLOCKS))
    if not found.covariance.isfinite().all():
        return found
    jackknife = freedom * found.covariance
    variances = [torch.linalg.inv(at.hessian.sum(dim=0) / 2).diagonal(), jackknife.diagonal()]
    if longer.covariance.isfinite().all():
        variances.append(freedom * longer.covariance.diagonal())
    growth = (torch.stack(variances).amax(dim=0) / jackknife.diagonal()).sqrt()
    return Jackknife(growth[:, None] * jackknife * growth, found.blocks)


def pixel_effect(camera: PinholeCamera, names: Sequence[str], covariance: Tensor) -> float:
    """Uncertainty of the pixels of an image that is caused by parameters: root mean square, pixels.

    Args:
        camera: Camera.
        names: Names of the parameters.
        covariance: Covariance of the parameters, shape :math:`(C, C)`.
    """
    u, v = (torch.linspace(0, size - 1, _GRID, dtype=torch.float64) for size in (camera.width, camera.height))
    rays = camera.normalise(camera.undistort(torch.cartesian_prod(u, v)))
    rays = torch.cat([rays, torch.ones_like(rays[:, :1])], dim=1)
    columns = []
    for name in names:
        step, value = DERIVATIVE_STEPS[name], get_values(camera, 0.0, [name])[0]
        ahead, behind = (with_values(camera, {name: value + sign * step}) for sign in (1, -1))
        moved = ahead.distort(ahead.project(rays)) - behind.distort(behind.project(rays))
        columns.append(moved / (2 * step))
    by_parameter = torch.stack(columns, dim=-1)  # (pixels, 2, C)
    return float(((by_parameter @ covariance) * by_parameter).sum(dim=(1, 2)).mean().sqrt())
