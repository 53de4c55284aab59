"""Calibration of a camera from a finished run: intrinsics, depth, readout and delay, each with its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from v3d_torch.calibration.edge_alignment import MAX_REGISTERED_SHIFT, MIN_VIEWS, EdgeAlignment
from v3d_torch.calibration.focal_length import better_focal_lengths
from v3d_torch.calibration.metric_scale import metric_scale
from v3d_torch.calibration.parameters import with_values
from v3d_torch.calibration.problem import SelfCalibration
from v3d_torch.calibration.selection import Estimate, ParameterSelection, decide
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.types import Trajectory

_DELAY_TOLERANCE = 0.003
"""Maximum accepted standard deviation of the depth delay, seconds: 3 pixels in an image that moves by 1000 pixels per
second."""

_SCALE_TOLERANCE = 0.01
"""Maximum accepted relative standard deviation of the depth scale."""

_SIGNIFICANCE = 3.0
"""Number of standard deviations by which focal lengths must differ from those of a run to be those of the next."""

_MAX_KEYFRAMES, _MAX_VIEWS = 200, 300
"""Maximum number of keyframes, the newest, and of views, evenly spread: memory grows with keyframes times landmarks,
and more of them hardly make the estimates more accurate."""


@dataclass(frozen=True)
class Calibration:
    """Calibrated camera.

    Attributes:
        camera: The given camera with the accepted estimates as new values.
        next_camera: Camera for another run. If no focal lengths are accepted, it has those of this run, or others that
            explain the motion of the images better: a map that was built with wrong ones gives no accurate ones.
        estimates: Estimates of all parameters.
    """

    camera: PinholeCamera
    next_camera: PinholeCamera
    estimates: tuple[Estimate, ...]

    @property
    def accepted(self) -> dict[str, Estimate]:
        """The accepted estimates, by the name of the parameter."""
        return {each.name: each for each in self.estimates if each.accepted}


def calibrate_camera(
    tables: MapTables,
    views: StaticViews,
    trajectory: Trajectory,
    groundtruth: Trajectory | None,
    camera: PinholeCamera,
    given: PinholeCamera,
    config: Config,
) -> Calibration:
    """Estimate the parameters of a camera from a run, and accept the estimates that the recording determines.

    Args:
        tables: Data of the map of the run.
        views: Static views of its keyframes.
        trajectory: Poses of all frames.
        groundtruth: Measured poses in metres, which determine the depth scale; None if there are none.
        camera: Camera with which the run was made.
        given: Camera before calibration; its values are kept for parameters that the recording does not determine.
        config: Configuration of the run.
    """
    estimates = [
        *ParameterSelection(SelfCalibration(tables, camera, config, given, max_keyframes=_MAX_KEYFRAMES)).estimates,
        _estimate_delay(views, trajectory, camera, given),
        *_estimate_scale(groundtruth, trajectory, camera, given),
    ]
    accepted = {each.name: each.value for each in estimates if each.accepted}
    calibrated = next_camera = with_values(given, accepted)
    if "fx" not in accepted:
        fx, fy = better_focal_lengths(tables, camera, config) or _rejected_focal_lengths(estimates, camera)
        next_camera = replace(calibrated, fx=fx, fy=fy)
    return Calibration(calibrated, next_camera, tuple(estimates))


def _rejected_focal_lengths(estimates: Sequence[Estimate], camera: PinholeCamera) -> tuple[float, float]:
    """Estimated focal lengths if they differ significantly from those of the run, else those of the run."""
    fx, fy = (each for name in ("fx", "fy") for each in estimates if each.name == name)
    is_significant = any(abs(each.value - getattr(camera, each.name)) > _SIGNIFICANCE * each.sigma for each in (fx, fy))
    return (fx.value, fy.value) if is_significant else (camera.fx, camera.fy)


def _estimate_delay(
    views: StaticViews, trajectory: Trajectory, camera: PinholeCamera, given: PinholeCamera
) -> Estimate:
    """Estimate the delay of depth from occlusion boundaries and edges of the colour images."""
    alignment = EdgeAlignment(views, trajectory, camera.depth_delay, max_views=_MAX_VIEWS)
    value, sigma, blocks = math.nan, math.inf, 0
    if len(alignment) >= MIN_VIEWS:
        starts = alignment.search(), torch.zeros(3, dtype=torch.float64)
        found = max(map(alignment.refine, starts), key=lambda each: alignment.total_score(each.values))
        # A larger shift means that the depth is not registered, or that other edges fit by chance.
        if float(found.values[:2].norm()) < MAX_REGISTERED_SHIFT * camera.width:
            value, sigma = camera.depth_delay + float(found.values[2]), float(found.sigma[2])
            blocks = found.blocks
    return decide("depth_delay", given.depth_delay, value, sigma, blocks, _DELAY_TOLERANCE)


def _estimate_scale(
    groundtruth: Trajectory | None, trajectory: Trajectory, camera: PinholeCamera, given: PinholeCamera
) -> list[Estimate]:
    """Estimate the depth scale from measured poses; depth in floating point has none."""
    if camera.depth_scale is None or given.depth_scale is None:
        return []
    measured = None if groundtruth is None else metric_scale(groundtruth, trajectory)
    ratio, sigma, blocks = (math.nan, math.inf, 0) if measured is None else measured
    value = camera.depth_scale / ratio
    tolerance = _SCALE_TOLERANCE * given.depth_scale
    return [decide("depth_scale", given.depth_scale, value, value * sigma / ratio, blocks, tolerance)]
