"""Shift of features: how far the features on an object move together, against the camera motion.

Features on a static object are where the camera motion moves them, up to noise. Those on a moving object are displaced,
all in the same direction. In one frame a slow motion is smaller than the noise, but within some tenths of a second the
displacements add up. The displacements of other parts of the image, which stand still, are added up in the same way.
They show how much of a sum is due to errors of the camera motion, of the depth and of the rolling shutter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_MIN_FEATURES = 8
"""Minimum number of matched features whose median is known well enough."""

_GRID = (3, 4)
"""Rows and columns of cells into which an image is divided. The features of an object are compared with those of the
cells, which are about as large."""

_MIN_CELLS = 3
"""Minimum number of cells with enough features, so that not all of them are on one moving object."""

_QUANTILE = 0.9
"""A moving object is displaced further than this fraction of the cells. Where the lens model or the depth is wrong,
static places are displaced, too."""

_MIN_SIGMAS = 4.0
"""Minimum shift of a moving object beyond that of other places, in standard deviations: an object is tested in every
frame, and a wrong decision lasts for a second."""

_MIN_SIGMA = 0.25
"""Minimum standard deviation of a shift, pixels: positions of features are hardly more accurate."""

_SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation of normally distributed values, relative to their median absolute deviation."""


@dataclass(frozen=True)
class FeatureShift:
    """Shift of the features on an object, in one frame or summed over several.

    Attributes:
        pixels: Median displacement, along u and v, pixels.
        variance: Variance of its noise, of both axes together, square pixels.
        elsewhere: Median displacement in each cell of the image outside of all objects, along u and v, pixels,
            float64, shape :math:`(C, 2)`; NaN for cells with too few features.
    """

    pixels: tuple[float, float]
    variance: float
    elsewhere: Tensor

    @property
    def is_motion(self) -> bool:
        """True if the object has moved: it is displaced significantly more than nearly all other places."""
        beyond = math.hypot(*self.pixels) - _MIN_SIGMAS * max(math.sqrt(self.variance), _MIN_SIGMA)
        return beyond > 0 and beyond > self._displacement_elsewhere

    @property
    def _displacement_elsewhere(self) -> float:
        """Displacement of nearly all other places, pixels; infinite if too few are known."""
        displacement = self.elsewhere.norm(dim=1)
        known = displacement[displacement.isfinite()]
        return float(known.quantile(_QUANTILE)) if len(known) >= _MIN_CELLS else math.inf


def sum_shifts(shifts: Iterable[FeatureShift]) -> FeatureShift:
    """Add up the shifts of consecutive frames, whose noise is independent.

    A cell that is not known in some of the frames has its mean displacement there.
    """
    pixels, variances, elsewhere = zip(*((each.pixels, each.variance, each.elsewhere) for each in shifts), strict=True)
    u, v = zip(*pixels, strict=True)
    return FeatureShift((sum(u), sum(v)), sum(variances), len(elsewhere) * torch.stack(elsewhere).nanmean(dim=0))


def feature_shifts(
    pixel: Tensor, residuals: Tensor, on_objects: Tensor, size: Sequence[int]
) -> list[FeatureShift | None]:
    """Measure the shift of each object in a frame.

    Args:
        pixel: Pixel (column, row) of each feature, int64, shape :math:`(N, 2)`.
        residuals: Displacement of each feature against the camera motion, pixels, float64, shape :math:`(N, 2)`; NaN if
            it is not known.
        on_objects: Features on each of K objects, bool, shape :math:`(K, N)`.
        size: Height and width of the image, pixels.

    Returns:
        Shift of each object; None if too few displacements are known.
    """
    known = torch.nonzero(residuals.isfinite().all(dim=1))[:, 0]
    inside = on_objects[:, known].numpy()
    if (inside.sum(axis=1) < _MIN_FEATURES).all():
        return [None] * len(on_objects)
    displacement = residuals[known].numpy()
    (u, v), (height, width) = pixel[known].T, size
    cell = (v * _GRID[0] // height * _GRID[1] + u * _GRID[1] // width).numpy()
    outside = ~inside.any(axis=0)
    elsewhere = _displacements_of_cells(displacement[outside], cell[outside])
    return [_shift(each, elsewhere) if _is_enough(each := displacement[on_object]) else None for on_object in inside]


def _is_enough(displacement: NDArray[np.float64]) -> bool:
    return len(displacement) >= _MIN_FEATURES


def _displacements_of_cells(displacement: NDArray[np.float64], cell: NDArray[np.int64]) -> Tensor:
    """Return the median displacement of each cell, shape (C, 2); NaN for cells with too few features."""
    of_cells = (displacement[cell == k] for k in range(_GRID[0] * _GRID[1]))
    medians = [_median(each) if _is_enough(each) else np.full(2, np.nan) for each in of_cells]
    return torch.from_numpy(np.stack(medians))


def _shift(displacement: NDArray[np.float64], elsewhere: Tensor) -> FeatureShift:
    median = _median(displacement)
    sigma = _SIGMA_OF_MEDIAN * _median(np.abs(displacement - median))
    return FeatureShift(tuple(median.tolist()), float(np.square(sigma).sum()) / len(displacement), elsewhere)


def _median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median of each column; for few values faster than that of NumPy."""
    ordered, count = np.sort(values, axis=0), len(values)
    return np.asarray((ordered[(count - 1) // 2] + ordered[count // 2]) / 2, np.float64)
