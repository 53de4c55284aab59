"""Self-calibration: bundle adjustment with free parameters of the camera, by variable projection.

For given parameters, poses and points are adjusted by the bundle adjustment of the map. The minimum cost is a function
of the parameters alone, and is minimised by damped Gauss-Newton steps with its exact derivatives (variable projection:
Golub and Pereyra, SIAM Journal on Numerical Analysis 1973; self-calibration: Triggs et al., Bundle Adjustment - A
Modern Synthesis, 2000). Therefore every camera model that can undistort pixels can be calibrated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from v3d_torch.calibration.parameters import DERIVATIVE_STEPS, LIMITS, get_values, with_values
from v3d_torch.calibration.reduced_cost import differentiate_minimum_cost
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.bundle_adjustment import bundle_adjust
from v3d_torch.mapping.bundle_problem import prepare_bundle
from v3d_torch.mapping.map_observations import MapObservations, select_observations
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.optim.levenberg_marquardt import levenberg_marquardt
from v3d_torch.optim.reprojection import reprojection_residuals

_MAX_STEPS = 20
"""Maximum number of steps of the parameters."""

_INNER_STEPS = 4
"""Maximum number of steps of poses and points between two steps of the parameters."""

_TOLERANCE = 1e-6
"""Relative change of the cost that ends the optimisation."""

_SCALE_STEP = 1.0
"""Distance over which the scale of undistortion is measured, pixels."""

_NORMAL_MAD = 0.6745
"""Median absolute value of a standard normal distribution."""


class Adjustment(NamedTuple):
    """Poses and points adjusted for given parameters.

    Attributes:
        cost: Minimum cost, shape :math:`()`.
        T_cw: World-to-camera poses, float64, shape :math:`(K, 4, 4)`.
        points: Landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        arguments: Observations with these parameters, as arguments of `bundle_adjust`.
    """

    cost: Tensor
    T_cw: Tensor
    points: Tensor
    arguments: dict[str, Any]


class CostDerivatives(NamedTuple):
    """Poses and points adjusted for given parameters, and the derivatives of the minimum cost at these parameters.

    Attributes:
        T_cw: World-to-camera poses, float64, shape :math:`(K, 4, 4)`.
        points: Landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        gradient: First derivatives of each keyframe's cost with respect to the parameters, float64, shape
            :math:`(K, C)`.
        hessian: Second derivatives, shape :math:`(K, C, C)`.
    """

    T_cw: Tensor
    points: Tensor
    gradient: Tensor
    hessian: Tensor


State = tuple[Tensor, Tensor, Tensor]
"""Values of the free parameters (C,), poses ``T_cw`` (K, 4, 4) and points (P, 3)."""


class SelfCalibration:
    """Calibration of a camera from the keyframes and landmarks of a map that was built with it.

    Args:
        tables: Data of the map.
        camera: Camera with which the map was built.
        config: Configuration of the run: measurement noise.
        given: Camera with the values of the parameters that are not free; None for ``camera``.
        max_keyframes: Maximum number of keyframes, of which the newest are used; None for all.

    Attributes:
        given: Camera with the values of the parameters that are not free.
        observations: Observations of the map, with noise estimated from its residuals.
        T_cw: World-to-camera poses of the keyframes, adjusted with the given camera, float64, shape
            :math:`(K, 4, 4)`.
        points: Landmarks, adjusted with the given camera, float64, shape :math:`(P, 3)`.
    """

    def __init__(
        self,
        tables: MapTables,
        camera: PinholeCamera,
        config: Config,
        given: PinholeCamera | None = None,
        max_keyframes: int | None = None,
    ) -> None:
        active = torch.tensor([keyframe.index for keyframe in tables.active_keyframes], dtype=torch.int64)
        window = active if max_keyframes is None else active[-max_keyframes:]
        self.observations = select_observations(tables, window, config, with_neighbours=False)
        keyframes, landmarks = self.observations.keyframes, self.observations.landmarks
        self.given = camera if given is None else given
        self._camera, self._readout = camera, tables.readout.seconds
        self._given_readout = self._readout if self.given.readout is None else self.given.readout
        self._fixed = torch.arange(len(keyframes)) == 0  # fixes the gauge
        self._pixel = camera.distort(self.observations.measured.uv)  # in the recorded image
        _, self._scale = _undistort_with_scale(camera, self._pixel)
        self._readout_jacobian = tables.observations["readout_jacobian"].index_select(0, self.observations.rows)
        self.T_cw, self.points = tables.T_cw[keyframes], tables.landmarks["point"][landmarks]
        for _ in range(2):
            arguments = self.observations.arguments(camera.K, self._fixed)
            adjusted = bundle_adjust(self.T_cw, self.points, **arguments, iterations=_MAX_STEPS, tolerance=_TOLERANCE)
            self.T_cw, self.points = adjusted.T_cw, adjusted.points
            self.observations = self._with_estimated_noise()

    @property
    def residual_count(self) -> int:
        """Number of residuals: two pixel coordinates of each observation, and its depth if it was measured."""
        return 2 * len(self.observations) + int((self.observations.measured.inverse_depth > 0).sum())

    @property
    def unknown_count(self) -> int:
        """Number of unknowns of poses and points."""
        return 6 * int((~self._fixed).sum()) + 3 * len(self.points)

    def given_values(self, names: Sequence[str]) -> Tensor:
        """Given values of parameters, float64, shape :math:`(C,)`; for an unknown readout, that of the map."""
        return torch.tensor(get_values(self.given, self._given_readout, names), dtype=torch.float64)

    def minimise(self, names: Sequence[str], start: Tensor | None = None) -> tuple[Tensor, CostDerivatives]:
        """Find the values of parameters with the lowest cost.

        Args:
            names: Free parameters.
            start: Initial values; None for the given values.

        Returns:
            Values, float64, shape :math:`(C,)`, and the map adjusted for them.
        """

        def linearise(state: State) -> tuple[Tensor, CostDerivatives]:
            return self.linearise(names, *state)

        def step(state: State, at: CostDerivatives, damping: Tensor) -> State:
            return _damped_step(names, state[0], at, damping), at.T_cw, at.points

        values = self.given_values(names) if start is None else start
        found = levenberg_marquardt((values, self.T_cw, self.points), linearise, step, _MAX_STEPS, _TOLERANCE)
        return found.state[0], found.system

    def linearise(
        self, names: Sequence[str], values: Tensor, T_cw: Tensor, points: Tensor
    ) -> tuple[Tensor, CostDerivatives]:
        """Adjust poses and points for given values of parameters, and differentiate the minimum cost.

        Args:
            names: Free parameters.
            values: Their values, float64, shape :math:`(C,)`.
            T_cw: Initial poses, float64, shape :math:`(K, 4, 4)`.
            points: Initial points, float64, shape :math:`(P, 3)`.

        Returns:
            Cost, shape :math:`()`, and the adjusted map.
        """
        adjusted = self.adjust(names, values, T_cw, points)
        return adjusted.cost, self.differentiate(names, values, adjusted)

    def adjust(self, names: Sequence[str], values: Tensor, T_cw: Tensor, points: Tensor) -> Adjustment:
        """Adjust poses and points for given values of parameters; the arguments are those of `linearise`."""
        observations, camera = self._measured_with(names, values)
        arguments = observations.arguments(camera.K, self._fixed)
        adjusted = bundle_adjust(T_cw, points, **arguments, iterations=_INNER_STEPS, tolerance=_TOLERANCE)
        return Adjustment(adjusted.cost_after, adjusted.T_cw, adjusted.points, arguments)

    def differentiate(self, names: Sequence[str], values: Tensor, adjusted: Adjustment) -> CostDerivatives:
        """Differentiate the minimum cost by parameters.

        Args:
            names: Free parameters.
            values: Their values, float64, shape :math:`(C,)`.
            adjusted: Result of `adjust` for these values.

        Returns:
            The map with the derivatives.
        """
        T_cw, points = adjusted.T_cw, adjusted.points
        problem, state, _ = prepare_bundle(T_cw, points, **adjusted.arguments, weights=None, valid=None)
        derivatives = differentiate_minimum_cost(problem, state, self.jacobian(names, values, T_cw, points))
        return CostDerivatives(T_cw, points, *derivatives)

    def residuals(self, names: Sequence[str], values: Tensor, T_cw: Tensor, points: Tensor) -> Tensor:
        """Whitened residuals of pixels and inverse depth, float64, shape :math:`(3, M)`."""
        return _whitened_residuals(*self._measured_with(names, values), T_cw, points)

    def jacobian(self, names: Sequence[str], values: Tensor, T_cw: Tensor, points: Tensor) -> Tensor:
        """Derivatives of the whitened residuals with respect to the parameters, numerical, shape :math:`(C, 3, M)`."""
        rows = []
        for index, name in enumerate(names):
            step = torch.zeros_like(values).index_fill_(0, torch.tensor(index), DERIVATIVE_STEPS[name])
            ahead, behind = (self.residuals(names, values + sign * step, T_cw, points) for sign in (1, -1))
            rows.append((ahead - behind) / (2 * DERIVATIVE_STEPS[name]))
        return torch.stack(rows)

    def _measured_with(self, names: Sequence[str], values: Tensor) -> tuple[MapObservations, PinholeCamera]:
        """Observations that a camera with other parameters would have made, and this camera."""
        of_name = dict(zip(names, values.tolist(), strict=True))
        readout = of_name.pop("readout", self._given_readout)
        camera = with_values(self.given, of_name)
        uv, scale = _undistort_with_scale(camera, self._pixel)
        measured = self.observations.measured
        change = camera.inverse_depth_offset - self._camera.inverse_depth_offset
        changed = replace(
            measured,
            uv=uv + (readout - self._readout) * self._readout_jacobian,
            inverse_depth=torch.where(measured.inverse_depth > 0, measured.inverse_depth + change, 0.0),
            pixel_sigma=scale * measured.pixel_sigma,
        )
        return replace(self.observations, measured=changed), camera

    def _with_estimated_noise(self) -> MapObservations:
        """Return the observations with standard deviations estimated from their residuals in the given map."""
        measured = self.observations.measured
        residuals = _whitened_residuals(self.observations, self._camera, self.T_cw, self.points).abs()
        in_image = residuals[:2] / self._scale  # in the recorded image
        depth = residuals[2, measured.inverse_depth > 0]
        freedom = math.sqrt(self.residual_count / max(self.residual_count - self.unknown_count, 1))
        pixel, inverse_depth = (
            float(errors.median()) * freedom / _NORMAL_MAD if len(errors) else 1.0
            for errors in (in_image.flatten(), depth)
        )
        estimated = replace(
            measured,
            pixel_sigma=pixel * measured.pixel_sigma,
            inverse_depth_sigma=inverse_depth * measured.inverse_depth_sigma,
        )
        return replace(self.observations, measured=estimated)


def _whitened_residuals(observations: MapObservations, camera: PinholeCamera, T_cw: Tensor, points: Tensor) -> Tensor:
    """Whitened residuals of all observations, (3, M)."""
    T = T_cw[observations.pose]
    in_camera = (T[:, :3, :3] @ points[observations.point, :, None])[..., 0] + T[:, :3, 3]
    return reprojection_residuals(in_camera, observations.measured, camera.K).mT


def _undistort_with_scale(camera: PinholeCamera, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Undistort pixels, and return the scale of undistortion around them.

    The noise of the recorded pixels is known, and undistortion scales it. Without this scaling, a distortion that
    shrinks the image would also shrink the residuals, and always seem to fit better.

    Returns:
        Undistorted pixels, shape :math:`(N, 2)`, and the square root of the determinant of the Jacobian, shape
        :math:`(N,)`.
    """
    uv = camera.undistort(pixel)
    steps = torch.tensor([[_SCALE_STEP, 0.0], [0.0, _SCALE_STEP]])
    by_u, by_v = (camera.undistort(pixel + step) - uv for step in steps)
    determinant = by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0]
    return uv, determinant.abs().sqrt() / _SCALE_STEP


def _damped_step(names: Sequence[str], values: Tensor, at: CostDerivatives, damping: Tensor) -> Tensor:
    """Values of the parameters after a damped Gauss-Newton step, within their limits."""
    gradient, hessian = at.gradient.sum(dim=0), at.hessian.sum(dim=0)
    diagonal = damping * hessian.diagonal() + torch.finfo(torch.float64).tiny
    values = values - torch.linalg.solve(hessian + diagonal.diag(), gradient)
    low, high = torch.tensor([LIMITS.get(name, (-torch.inf, torch.inf)) for name in names], dtype=torch.float64).T
    return values.clamp(low, high)
