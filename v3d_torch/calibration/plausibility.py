"""Plausibility of the camera and of the depth images, without ground truth.

Each check compares the images with each other or with a property of all scenes or sensors, and warns only if they
contradict the camera significantly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from v3d_torch.calibration.depth_steps import disparity_step
from v3d_torch.calibration.edge_alignment import MAX_REGISTERED_SHIFT, MIN_VIEWS, EdgeAlignment, Misalignment
from v3d_torch.calibration.focal_length import better_focal_lengths
from v3d_torch.calibration.people_size import check_people_size
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.static_views import StaticView, StaticViews
from v3d_torch.types import Trajectory

_FIRST_VIEWS, _MAX_VIEWS = 8, 32
"""Number of views whose edges are compared first, which takes a tenth of a second, and number of views for a more
accurate estimate if these do not seem to fit."""

_SUSPICION = 0.5
"""Fraction of the limits of shift and delay above which a first, inaccurate estimate is followed by a more accurate
one."""

_MIN_DELAY = 0.05
"""Minimum delay of depth that is reported, seconds: more than half a frame period, the maximum delay of cameras without
synchronisation."""

_SHIFT, _DELAY = (0, 1), (2,)
"""Indices of the shift and of the delay of depth in the values of a `Misalignment`."""

_SIGNIFICANCE = 3.0
"""Number of standard deviations by which an estimate must exceed the limits above."""

_KINECT_STEP = 0.0029
"""Step of inverse depth of the Kinect and of other cameras with its sensor (Xtion, Structure), 1/m: an eighth of a
pixel, divided by a focal length of 575 pixels and a baseline of 0.075 m."""

_STEP_TOLERANCE = 1.14
"""Maximum accepted ratio of the steps to those of a Kinect; its inverse is the minimum."""

_MAX_STEP_RATIO = 1.5
"""Steps of a Kinect divided by this: cameras with finer steps are not a Kinect."""

_KINECT_FOCAL_LENGTHS = (0.75, 1.0)
"""Focal length of cameras with the sensor of the Kinect, relative to the width of the image."""

_DEPTH_VIEWS = 4
"""Number of views whose depth is examined."""

_MIN_MEASURED = 100
"""Minimum number of pixels with depth of a view whose depth can be constant; fewer can be equal by chance."""

_RANGE_QUANTILES = (0.01, 0.99)
"""Quantiles between which nearly all depth of a view lies: single pixels can be wrong."""

_MIN_TURN = 0.05
"""Angle between optical axes above which a plane cannot have the same depth at all pixels of both views, radians: at a
distance of 2 m it makes a difference of a decimetre."""

_FAR = (2.5, 10.0)
"""Depths for a warning that depth is too large, metres: 99 % of the measurements exceed the first, and 1 % the second.
RGB-D cameras measure up to about 10 m."""

_NEAR = 0.3
"""Median depth below which depth is too small, metres: most RGB-D cameras do not measure below it."""


def check_plausibility(
    tables: MapTables,
    views: StaticViews,
    people_sizes: Sequence[float],
    trajectory: Trajectory,
    camera: PinholeCamera,
    config: Config,
) -> list[str]:
    """Check whether the camera and the depth images agree with a map that was built with them.

    Args:
        tables: Data of the map.
        views: Static views of its keyframes.
        people_sizes: Apparent sizes of people in its keyframes, see `apparent_sizes`, metres.
        trajectory: Poses of all frames so far.
        camera: Camera of the frames.
        config: Configuration of the run.

    Returns:
        One sentence with the likely cause for each contradiction.
    """
    if constant := _check_constant_depth(views):
        return constant  # no path agrees with it, so that the focal lengths would seem to be wrong
    registration = _check_registration(views, trajectory, camera)
    # If depth is not registered, no focal length fits.
    focal_length = [] if registration else _check_focal_length(tables, camera, config)
    depth_scale = _check_depth_scale(views, camera) or check_people_size(people_sizes, camera)
    return [*depth_scale, *registration, *focal_length]


def _examined_views(views: StaticViews) -> list[StaticView]:
    """Return some views at equal intervals."""
    own = views.own
    return own[:: max(-(-len(own) // _DEPTH_VIEWS), 1)]


def _measured(view: StaticView) -> Tensor:
    """Depth of the pixels that have depth, metres, (N,)."""
    return view.depth[view.depth > 0]


def _check_constant_depth(views: StaticViews) -> list[str]:
    """Check whether most views have the same depth at nearly all pixels, although the camera turns.

    Only a plane has the same depth everywhere, and only from one direction.
    """
    examined = [view for view in _examined_views(views) if len(_measured(view)) >= _MIN_MEASURED]
    ranges = [np.quantile(_measured(view).numpy(), _RANGE_QUANTILES).tolist() for view in examined]
    constant = [view for view, (low, high) in zip(examined, ranges, strict=True) if low == high]
    if 2 * len(constant) <= len(examined):
        return []
    axes = torch.stack([view.T_dw[2, :3] for view in constant])  # optical axes in the world frame
    if float((axes @ axes.T).min()) > math.cos(_MIN_TURN):
        return []
    return [
        f"the depth is {float(_measured(constant[-1]).median()):.2g} m at nearly all pixels of an image although the"
        " camera turns; record or export the depth images again"
    ]


def _check_depth_scale(views: StaticViews, camera: PinholeCamera) -> list[str]:
    """Compare depth with the range of RGB-D cameras, and its steps with those of the Kinect.

    Depth in floating point has no depth scale and is not checked.
    """
    if camera.depth_scale is None:
        return []
    depth = torch.cat([torch.zeros(0), *map(_measured, _examined_views(views))])
    if not len(depth):
        return []
    ratio = _kinect_step_ratio(depth, camera)
    if ratio is not None and not 1 / _STEP_TOLERANCE < ratio < _STEP_TOLERANCE:
        error = f"{ratio:.3g} times too large" if ratio > 1 else f"{1 / ratio:.3g} times too small"
        return [
            f"the steps of the depth images are {ratio:.3g} times those of a Kinect or Xtion; if the camera, which has"
            f" their field of view, is one of them, the depth_scale {camera.depth_scale:g} is {error}; other cameras,"
            " such as stereo cameras, have other steps"
        ]
    low, median, high = np.quantile(depth.numpy(), (0.01, 0.5, 0.99)).tolist()  # torch limits the number of values
    if low > _FAR[0] and high > _FAR[1]:
        return [
            f"the depth images range from {low:.2g} to {high:.2g} m, but RGB-D cameras measure up to about 10 m; the"
            f" depth_scale {camera.depth_scale:g} seems to be too small"
        ]
    if median < _NEAR:
        return [
            f"half of the depth is nearer than {median:.2g} m, where most RGB-D cameras do not measure; the depth_scale"
            f" {camera.depth_scale:g} seems to be too large"
        ]
    return []


def _kinect_step_ratio(depth: Tensor, camera: PinholeCamera) -> float | None:
    """Steps of the depth relative to those of a Kinect; None for another camera, or if there are no steps."""
    low, high = _KINECT_FOCAL_LENGTHS
    if not low < camera.fx / camera.width < high:
        return None
    step = disparity_step(depth)
    return None if step is None or step * _MAX_STEP_RATIO < _KINECT_STEP else step / _KINECT_STEP


def _check_registration(views: StaticViews, trajectory: Trajectory, camera: PinholeCamera) -> list[str]:
    """Compare occlusion boundaries with edges of the colour images."""
    alignment = EdgeAlignment(views, trajectory, camera.depth_delay, _FIRST_VIEWS)
    if len(alignment) < MIN_VIEWS:
        return []
    first = alignment.search()
    if (
        float(first[:2].norm()) < _SUSPICION * MAX_REGISTERED_SHIFT * camera.width
        and abs(first[2]) < _SUSPICION * _MIN_DELAY
    ):
        return []
    alignment = EdgeAlignment(views, trajectory, camera.depth_delay, _MAX_VIEWS)
    delayed, shifted = (alignment.refine(alignment.search(free), free) for free in (_DELAY, _SHIFT))
    # The simplest explanation that is better than none, and of two the one that is better.
    nothing = torch.zeros(3, dtype=torch.float64)
    likelier = max((delayed, shifted), key=lambda each: alignment.total_score(each.values))
    if alignment.is_better(likelier.values, nothing) and (warnings := _warn_of(likelier, camera)):
        return warnings
    both = alignment.refine(alignment.search())
    for simpler, free in ((delayed, _SHIFT), (shifted, _DELAY)):
        if alignment.is_better(both.values, simpler.values) and (warnings := _warn_of(both, camera, free)):
            return warnings
    return []


def _warn_of(found: Misalignment, camera: PinholeCamera, free: tuple[int, ...] = (*_SHIFT, *_DELAY)) -> list[str]:
    """Return a sentence on a shift or a delay that is significantly larger than what cameras have, or nothing.

    Args:
        found: Shift and delay.
        camera: Camera of the frames.
        free: Indices of the values that are judged.
    """
    shift, delay = found.values[:2], float(found.values[2])
    margin = _SIGNIFICANCE * found.sigma
    if free != _DELAY and float(shift.norm() - margin[:2].norm()) > MAX_REGISTERED_SHIFT * camera.width:
        u, v = (-shift).round().int().tolist()
        return [
            f"the depth images seem to be shifted by ({u}, {v}) pixels against the colour images; export depth that"
            " is registered to the colour image"
        ]
    if free != _SHIFT and abs(delay) - float(margin[2]) > _MIN_DELAY:
        side = "after" if delay > 0 else "before"
        return [
            f"the depth images seem to be taken {abs(delay):.2f} s {side} the time of their timestamps, relative to"
            " the colour images; correct the timestamps, or state depth_delay in the camera file"
        ]
    return []


def _check_focal_length(tables: MapTables, camera: PinholeCamera, config: Config) -> list[str]:
    """Compare the focal lengths with those that explain best how the images move."""
    better = better_focal_lengths(tables, camera, config)
    if better is None:
        return []
    fx, fy = better
    return [
        f"the focal lengths {camera.fx:g} and {camera.fy:g} do not explain how the images move, {fx:.0f} and {fy:.0f}"
        f" would be better; give the camera of images with {camera.width}x{camera.height} pixels, or"
        " calibrate it with v3d-torch calibrate"
    ]
