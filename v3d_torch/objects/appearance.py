"""Appearance of instances: histograms of their colours.

The colours of clothes distinguish people when one occludes another. A histogram hardly changes when the body or the
camera turns, and needs no network. Brightness and both colour axes have coarse bins, and each pixel also counts in the
neighbouring bins, so that a change of light changes the histogram little.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from kornia.color import rgb_to_lab
from numpy.typing import NDArray
from torch import Tensor

_BINS = 8
"""Number of bins for each of the three axes of the colour space CIELAB."""

HISTOGRAM_SIZE = _BINS**3
"""Number D of bins of a histogram."""

_BRIGHTEST = 100
"""Maximum of the brightness L in CIELAB."""

_COLOUR_STEP = 10
"""Width of a bin of the colour axes a and b in CIELAB: clothes differ from grey by up to 40."""

_GREY = _BINS / 2 + 0.5
"""Position of grey on a colour axis, in bins."""

_LEVELS = 32
"""Number of levels of red, green and blue for which the bin is computed: much finer than the bins."""

_STRIDE = 4
"""Every n-th row and column is counted; a person at 5 m still has some hundred of these pixels."""

_MIN_PIXELS = 10
"""Minimum number of counted pixels; with fewer the appearance is unknown."""


@cache
def _bins_of_colours() -> NDArray[np.int64]:
    """Return the bin of each colour, from 0 to D - 1, shape (levels of red, of green, of blue)."""
    level = (torch.arange(_LEVELS) + 0.5) / _LEVELS
    rgb = torch.stack(torch.meshgrid(level, level, level, indexing="ij"))
    brightness, a, b = rgb_to_lab(rgb.flatten(1, 2)).unflatten(1, rgb.shape[1:3])
    # Grey is in the middle of a bin: most clothes have little colour, and noise must not move them to another bin.
    axes = brightness * _BINS / _BRIGHTEST, a / _COLOUR_STEP + _GREY, b / _COLOUR_STEP + _GREY
    bins = [axis.floor().clamp(0, _BINS - 1).to(torch.int64) for axis in axes]
    return np.asarray(((bins[0] * _BINS + bins[1]) * _BINS + bins[2]).numpy())


def _smoothing_matrix() -> Tensor:
    """Return the matrix that distributes each bin over its neighbours, float32, shape (D, D)."""
    distance = np.abs(np.subtract.outer(np.arange(_BINS), np.arange(_BINS)))
    axis = np.where(distance == 0, 0.5, np.where(distance == 1, 0.25, 0.0))
    axis /= axis.sum(axis=1, keepdims=True)
    return torch.from_numpy(np.kron(np.kron(axis, axis), axis).astype(np.float32))


_SMOOTHING = _smoothing_matrix()


def colour_histograms(image: Tensor, masks: Tensor) -> Tensor:
    """Compute the colour histogram of each instance.

    Args:
        image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.
        masks: Pixels of N instances, bool, shape :math:`(N, H, W)`.

    Returns:
        Histograms that sum to 1, float32, shape :math:`(N, D)`; NaN for an instance with too few pixels.
    """
    if len(masks) == 0:
        return torch.empty(0, HISTOGRAM_SIZE, dtype=torch.float32)
    red, green, blue = image.numpy()[:, ::_STRIDE, ::_STRIDE] // (256 // _LEVELS)
    bins = _bins_of_colours()[red, green, blue].reshape(-1)
    inside = masks.numpy()[:, ::_STRIDE, ::_STRIDE].reshape(len(masks), bins.size)
    counts = [np.bincount(bins[mask], minlength=HISTOGRAM_SIZE) for mask in inside]
    counted = torch.from_numpy(np.array(counts, np.float32))
    total = counted.sum(dim=1, keepdim=True)
    return (counted @ _SMOOTHING / total).masked_fill(total < _MIN_PIXELS, torch.nan)


def histogram_similarity(a: Tensor, b: Tensor) -> Tensor:
    """Bhattacharyya coefficient of histograms: 1 if they are equal, 0 if they have no common bin.

    Args:
        a: Histograms that sum to 1, shape :math:`(*, A, D)`.
        b: Histograms that sum to 1, shape :math:`(*, B, D)`.

    Returns:
        Similarity of all pairs, shape :math:`(*, A, B)`; NaN if one of the histograms is NaN.
    """
    return a.sqrt() @ b.sqrt().transpose(-1, -2)
