"""Estimation of an unknown depth scale from depth images.

Depth in whole numbers has a depth scale, in units per metre, which a camera file, a data set or a device states. If
none of them does, the depth scale is estimated from the images, and a warning reports the estimate. If several scales
fit the images, an error asks the user for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3d_torch.geometry.depth_units import missing_value

MILLIMETRES = 1000.0
"""Depth scale of most devices and of ROS (REP 118)."""

UNITS: dict[float, str] = {
    100.0: "centimetres",
    MILLIMETRES: "millimetres",
    4000.0: "quarter millimetres, RealSense L515",
    5000.0: "fifths of a millimetre, TUM RGB-D benchmark",
    10000.0: "tenths of a millimetre, RealSense D405",
}
"""Depth scales that devices and data sets use, units per metre, with their names."""

_NEAREST, _LEAST_FAR, _FARTHEST = 0.25, 1.0, 10.0
"""Distances in a room, metres: the minimum range of depth cameras, a distance that some surface in the image exceeds,
and a distance that no surface exceeds."""

_FARTHEST_OF_OTHERS = 14.0
"""Largest distance in an image with which a depth scale still counts as possible, metres: beyond the range of RGB-D
cameras."""

_NEARER_THAN_ANY_CAMERA = 0.1
"""Distance that no depth camera measures, metres."""

_QUANTILES = (0.01, 0.5, 0.99)
"""Quantiles used as near, median and far depth: single wrong pixels do not change them."""

_MAX_STEP = 100
"""Maximum step between depth values that is searched for, units."""

_MIN_MULTIPLES = 0.95
"""Minimum fraction of the values that are multiples of a step. Other values come from interpolation."""

_MIN_VALUES = 30
"""Minimum number of different values for which a step is accepted. Fewer can be multiples of a number by chance."""

_STRIDE = 4
"""Every n-th row and column is examined, which is enough for quantiles."""


@dataclass(frozen=True)
class DepthScaleEstimate:
    """Depth scale estimated from depth images.

    Attributes:
        depth_scale: Units per metre; None if the images fit several scales or none.
        evidence: Description of the depth values, as a part of a sentence.
    """

    depth_scale: float | None
    evidence: str

    @property
    def note(self) -> str:
        """Sentence that reports the depth scale, which must not be None."""
        scale = self.depth_scale or np.nan
        return (
            f"depth scale {scale:g} ({UNITS[scale]}), estimated from {self.evidence}; state depth_scale in camera.yaml"
        )

    @property
    def file_prompt(self) -> str:
        """Cause and fix for an error that asks the user of a recording for the depth scale."""
        return (
            f"the unit of depth is not stated and cannot be estimated from the images ({self.evidence}); write the line"
            " depth_scale: 1000 into camera.yaml if depth is in millimetres, or else its units per metre (TUM: 5000)"
        )

    @property
    def array_prompt(self) -> str:
        """Cause and fix for an error that asks a programmer for the depth scale of an array."""
        scale = self.depth_scale or MILLIMETRES
        reason = f"which fits {self.evidence}" if self.depth_scale is not None else "if it is in millimetres"
        return (
            f"and its unit is not stated; give a PinholeCamera with depth_scale={scale:g}, {reason}, or metres in"
            f" floating point, depth / {scale:g}"
        )


def estimate_depth_scale(images: Iterable[NDArray[Any]]) -> DepthScaleEstimate:
    """Estimate the depth scale from depth images of a room.

    A depth scale fits if it gives distances that occur in a room. Most sensors measure in whole millimetres, so a step
    between the values shows that the unit of the file is finer: multiples of 5 are millimetres in units of 0.2 mm, or
    steps of 5 mm. Without such a step, and without near surfaces, the depth of a room in millimetres can have the same
    values as the depth of a desk in a finer unit. The estimate is the only depth scale of `UNITS` that fits.

    Args:
        images: Depth images with whole numbers, of any shape; 0 and the largest 16-bit value are no measurement.
    """
    samples = [image[..., ::_STRIDE, ::_STRIDE] for image in images]
    measured = [sample[(sample > 0) & (sample != missing_value(sample))] for sample in samples]
    values = np.concatenate([*measured, np.zeros(0, dtype=np.int64)])
    plural = "image" if len(samples) == 1 else "images"
    if not len(values):
        return DepthScaleEstimate(None, f"{len(samples)} depth {plural} without measurements")
    near, median, far = np.quantile(values, _QUANTILES)
    step = _find_step(values)
    candidates = list(UNITS)
    if step is not None:
        whole_millimetres = [scale for scale in UNITS if MILLIMETRES * step % scale == 0]
        if max(whole_millimetres) > MILLIMETRES:
            candidates = whole_millimetres
    fitting = [scale for scale in candidates if _is_room(near / scale, far / scale)]
    steps = f", in steps of {step}" if step is not None else ""
    found = None
    if len(fitting) == 1 and far / fitting[0] <= _FARTHEST:
        found = fitting[0] if _is_certain(fitting[0], near, candidates) else None
    evidence = f"{len(samples)} depth {plural} with values from {near:.0f} to {far:.0f}, median {median:.0f}{steps}"
    return DepthScaleEstimate(found, evidence)


def _find_step(values: NDArray[np.integer[Any]]) -> int | None:
    """Find the largest step of which nearly all values are multiples; None if the values are too few."""
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < _MIN_VALUES:
        return None
    needed = _MIN_MULTIPLES * len(values)
    return next(step for step in range(_MAX_STEP, 0, -1) if counts[distinct % step == 0].sum() >= needed)


def _is_certain(depth_scale: float, near: float, candidates: list[float]) -> bool:
    """Check whether the only depth scale that fits is certain, although distances differ between rooms."""
    if depth_scale < MILLIMETRES:  # a close view in millimetres has the same values
        return near < MILLIMETRES * _NEARER_THAN_ANY_CAMERA
    # Finer units differ by small factors; only the step between the values distinguishes them.
    return depth_scale == MILLIMETRES or len(candidates) < len(UNITS)


def _is_room(near: float, far: float) -> bool:
    """Check whether the near and the far depth, both in metres, can be distances in a room."""
    return near >= _NEAREST and _LEAST_FAR <= far <= _FARTHEST_OF_OTHERS
