r"""Online calibration of the rolling-shutter readout from the cost of bundle adjustment.

A wrong readout distorts the images of a rotating camera. A map with the same distortion explains these images equally
well, until the camera rotates in another direction. Calibration therefore uses the cost after all poses and points
are adjusted again, as a function of the readout. Near the current readout this cost is a parabola, whose minimum is an
estimate of the readout.

Each calibration uses all observations of the map once, and the expected readout once: so the expectation fades as fast
as evidence comes in, and not because time passes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.mapping.local_bundle_adjustment import LocalAdjustment
from v3d_torch.mapping.map_observations import MapObservations, select_observations
from v3d_torch.mapping.reduced_cost import reduced_cost_derivatives
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.optim.jackknife import jackknife_covariance

_MIN_INFLATION = 2.0
"""Smallest factor by which the standard deviation exceeds that of independent errors. Errors of velocity and depth are
correlated between observations, which few keyframes do not show."""

_MAX_KEYFRAMES = 60
"""Maximum number of keyframes, the newest ones, whose observations are used: the time grows with their cube."""


def calibrate_readout(
    sparse_map: SparseMap, adjustment: LocalAdjustment, config: Config, camera: PinholeCamera
) -> Readout:
    """Estimate the readout from the observations of the map and the expected readout.

    Args:
        sparse_map: The map; it is not changed.
        adjustment: Local bundle adjustment of the newest keyframe, not yet applied to the map.
        config: Configuration of the whole system: the expected readout, measurement noise.
        camera: Intrinsics.

    Returns:
        The new estimate. It equals the current one if no calibration is due, if the readout is certain, or if the
        current estimate used older keyframes and is more certain.
    """
    current = sparse_map.readout
    if not config.rolling_shutter.enabled or current.is_certain or not _is_due(sparse_map):
        return current
    active = torch.tensor([keyframe.index for keyframe in sparse_map.active_keyframes])
    selected = select_observations(sparse_map, active[-_MAX_KEYFRAMES:], config, with_neighbours=False)
    gradient, hessian = reduced_cost_derivatives(
        adjustment.T_cw[selected.keyframes],
        adjustment.points_of(sparse_map)[selected.landmarks],
        selected.observations,
        camera,
        torch.arange(len(selected.keyframes)) == 0,  # the gauge
        whitened_readout_jacobian(selected),
    )
    readout = combine(Readout.from_camera(camera, config.rolling_shutter), current.seconds, gradient, hessian)
    return current if len(active) > _MAX_KEYFRAMES and readout.information < current.information else readout


def whitened_readout_jacobian(selected: MapObservations) -> Tensor:
    """Derivative of the whitened residuals with respect to the readout, 1/s, float64, shape :math:`(M, 3, 1)`."""
    by_pixel = -selected.readout_jacobian / selected.observations.pixel_sigma[:, None]
    return torch.cat([by_pixel, torch.zeros_like(by_pixel[:, :1])], dim=1)[..., None]


def combine(expected: Readout, seconds: float, gradient: Tensor, hessian: Tensor) -> Readout:
    """Combine the expected readout with the minimum of a cost.

    Args:
        expected: Expected readout.
        seconds: Readout at which the derivatives were computed.
        gradient: First derivatives of the cost (twice the negative log-likelihood) of each keyframe with respect to
            the readout in seconds, float64, shape :math:`(K, 1)`.
        hessian: Second derivatives, shape :math:`(K, 1, 1)`.

    Returns:
        Mean of both, weighted with their information. The variance of the minimum is that of the jackknife over
        keyframes, but at least a multiple of that of independent errors. It is infinite if the camera stood still or
        moved uniformly.
    """
    curvature = float(hessian.sum())
    if curvature <= 0:
        return expected
    minimum = seconds - float(gradient.sum()) / curvature
    variance = max(float(jackknife_covariance(gradient, hessian)), _MIN_INFLATION**2 * 2 / curvature)
    total = expected.information + 1 / variance
    bounded = min(max(minimum, -MAX_READOUT), MAX_READOUT)
    return Readout((expected.information * expected.seconds + bounded / variance) / total, total)


def _is_due(sparse_map: SparseMap) -> bool:
    """Check whether the map has 2, 3, 4, 6, 8, 12, 16 ... keyframes: each change of the readout disturbs the map."""
    count = len(sparse_map.keyframes)
    while count % 2 == 0:
        count //= 2
    return count in (1, 3)
