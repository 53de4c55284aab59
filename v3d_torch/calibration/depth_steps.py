"""Quantisation step of the depth images of cameras that measure quantised disparity.

A structured-light camera measures disparity in steps of a fraction of a pixel. Inverse depth then has equal steps: the
step of disparity divided by focal length and baseline of the sensor (Khoshelham and Elberink, Accuracy and Resolution
of Kinect Depth Data, Sensors 2012). The steps therefore determine a length, the baseline.
"""

from __future__ import annotations

import torch
from torch import Tensor

_BIN = 5e-5
"""Width of the bins of inverse depth, 1/m: an eighth of the finest step, and a tenth of a millimetre at 1.5 m."""

_MAX_INVERSE_DEPTH = 8.0
"""Maximum inverse depth, 1/m: a depth of 0.125 m."""

_MIN_STEP, _MAX_STEP = 4e-4, 2e-2
"""Range of the steps that are searched, 1/m."""

_MIN_STRENGTH = 0.25
"""Minimum strength of steps; 1 if all measurements are multiples of a step, less than 0.05 for depth without steps."""

_HARMONIC = 0.5
"""Minimum strength of the true step relative to the best strength. Fractions of the true step fit as well, so the true
step is the largest with this strength."""

_PEAK_WIDTH = 1.06
"""Ratio between the steps at the two sides of a peak."""

_NEIGHBOURHOOD = 1.6
"""Maximum ratio between steps that are compared: steps within it are not multiples or fractions of the true step."""

_MIN_PROMINENCE = 6.0
"""Minimum strength relative to the median strength of neighbouring steps. A few parallel walls, each at one depth, give
the same strength for many steps."""


def disparity_step(depth: Tensor) -> float | None:
    """Find the step of inverse depth in depth images.

    Args:
        depth: Depth of many pixels, metres, any shape; 0 = no measurement.

    Returns:
        Step, 1/m; None if the depth has no such steps.
    """
    inverse = 1 / depth[depth > 0].to(torch.float64)
    inverse = inverse[inverse < _MAX_INVERSE_DEPTH]
    if len(inverse) == 0:
        return None
    size = round(_MAX_INVERSE_DEPTH / _BIN)
    histogram = torch.bincount((inverse / _BIN).long(), minlength=size).to(torch.float64)
    strength = torch.fft.rfft(histogram).abs() / len(inverse)  # cycles per _MAX_INVERSE_DEPTH
    cycles = torch.arange(len(strength))
    searched = (cycles >= _MAX_INVERSE_DEPTH / _MAX_STEP) & (cycles <= _MAX_INVERSE_DEPTH / _MIN_STEP)
    strength = strength.where(searched, 0.0)
    if float(strength.max()) < _MIN_STRENGTH:
        return None
    first = int(torch.nonzero(strength >= _HARMONIC * strength.max())[0, 0])
    peak = first + int(strength[first : int(first * _PEAK_WIDTH) + 1].argmax())
    around = strength[int(peak / _NEIGHBOURHOOD) : int(peak * _NEIGHBOURHOOD) + 1]
    return _MAX_INVERSE_DEPTH / peak if strength[peak] > _MIN_PROMINENCE * around.median() else None
