"""Appearance of instances: histograms of their colours.

The colours of clothes distinguish people when one occludes another. A histogram hardly changes when the body or the
camera turns, and needs no network. Brightness and both colour axes have coarse bins, and each pixel also counts in the
neighbouring bins, so that a change of light changes the histogram little.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

_BINS = 8
"""Number of bins for each of the three axes of the colour space CIELAB."""

HISTOGRAM_SIZE = _BINS**3
"""Number D of bins of a histogram."""

_COLOUR_STEP = 10
"""Width of a bin of the colour axes a and b, in units of OpenCV's 8-bit CIELAB: clothes differ from grey by up to
40."""

_STRIDE = 4
"""Every n-th row and column is counted; a person at 5 m still has some hundred of these pixels."""

_MIN_PIXELS = 10
"""Minimum number of counted pixels; with fewer the appearance is unknown."""


_BRIGHTNESS = np.arange(256) * _BINS // 256
_CHROMA = np.clip((np.arange(256) - 128) // _COLOUR_STEP + _BINS // 2, 0, _BINS - 1)
"""Bin of each 8-bit value of the brightness and of a colour axis."""


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
    colours = image.numpy()[:, ::_STRIDE, ::_STRIDE].transpose(1, 2, 0)
    lab = np.asarray(cv2.cvtColor(np.ascontiguousarray(colours), cv2.COLOR_RGB2LAB), np.uint8)
    brightness, a, b = (bins.take(lab[..., axis]) for axis, bins in enumerate((_BRIGHTNESS, _CHROMA, _CHROMA)))
    bins = ((brightness * _BINS + a) * _BINS + b).reshape(-1)
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
