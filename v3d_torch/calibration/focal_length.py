"""Search of the focal lengths that explain the motion of the images, far from the given ones."""

from __future__ import annotations

import torch

from v3d_torch.calibration.problem import SelfCalibration
from v3d_torch.calibration.selection import covariance
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.map_tables import MapTables

_MIN_KEYFRAMES, _MAX_KEYFRAMES = 5, 12
"""Minimum and maximum number of keyframes in the bundle adjustment."""

_MIN_CHANGE = 0.1
"""Minimum relative error of the given focal lengths: those of cameras of one model differ by a fifth of it."""

_MODEL_ERROR = 0.05
"""Relative error of an estimate due to lens distortion that is not modelled. A first, inaccurate estimate beyond it is
followed by a more accurate one."""

_SIGNIFICANCE = 3.0
"""Number of standard deviations by which the change of an estimate must exceed the model error."""

_MAX_FOCAL_LENGTH = 8.0
"""Longest plausible focal length, widths of the image: a field of view of 7 degrees."""

_FACTORS = (0.6, 1.0, 1.7)
"""Focal lengths relative to the given ones from which the minimum is searched. In a map that was built with wrong focal
lengths, the cost can have another minimum near these, or decrease without end towards long ones: matches that do not
fit have been left out of the map."""


def better_focal_lengths(tables: MapTables, camera: PinholeCamera, config: Config) -> tuple[float, float] | None:
    """Estimate focal lengths that explain the motion of the images significantly better than the given ones.

    The estimate comes from a map that was built with the given focal lengths, and is inaccurate if they are far from
    the true ones.

    Args:
        tables: Data of the map.
        camera: Camera with the focal lengths with which the map was built.
        config: Configuration of the run.

    Returns:
        fx and fy, pixels; None if the given ones are right within 10 %, or the map is too small to tell.
    """
    problem = SelfCalibration(tables, camera, config, max_keyframes=_MAX_KEYFRAMES)
    if len(problem.T_cw) < _MIN_KEYFRAMES:
        return None
    names = ("fx", "fy", "cx", "cy")  # a wrong principal point would change the focal lengths
    given = problem.given_values(names)
    scales = torch.tensor([[factor, factor, 1.0, 1.0] for factor in _FACTORS], dtype=torch.float64)
    tried = [problem.adjust(names, given * scale, problem.T_cw, problem.points) for scale in scales]
    best = min(range(len(tried)), key=lambda index: float(tried[index].cost))
    at = problem.differentiate(names, given * scales[best], tried[best])
    step = torch.linalg.pinv(at.hessian.sum(dim=0), hermitian=True) @ at.gradient.sum(dim=0)
    if not bool(((scales[best] - step / given - 1).abs()[:2] > _MODEL_ERROR).any()):
        return None
    minima = [problem.minimise(names, given * scale) for scale in scales]
    minima = [found for found in minima if bool((found[0][:2] <= _MAX_FOCAL_LENGTH * camera.width).all())]
    if not minima:
        return None
    values, at = min(minima, key=lambda found: float(problem.adjust(names, found[0], *found[1][:2]).cost))
    sigma = covariance(problem, at).covariance.diagonal().clamp(min=0).sqrt()
    change = (values / given).log().abs()
    needed = (_MODEL_ERROR + _SIGNIFICANCE * sigma / values).clamp(min=_MIN_CHANGE)
    if not bool((change > needed)[:2].any()):
        return None
    return float(values[0]), float(values[1])
