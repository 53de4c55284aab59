"""Association evidence: likelihood of an instance if it continues a track, relative to that of a new object.

Each kind of evidence is a log-likelihood ratio, as in multiple hypothesis tracking (Blackman, 2004): position, overlap
of the masks, appearance, class and vacancy. Their sum for a pair is positive if the instance more likely continues the
track than is a new object.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_NEW_OBJECT_VOLUME = 10.0
"""Inverse density of new objects, cubic metres: about the volume that the camera observes."""

_TAIL = 4.0
"""Degrees of freedom of Student's t-distribution of the innovations: some people turn or stop at once, and some masks
cover half of a person, so that large errors are more frequent than in a normal distribution."""

_MAX_VARIANCE = 1.0
"""Maximum variance of a coordinate, square metres: people who are out of view for seconds mostly stay in the room."""

_COVERAGE_WEIGHT = 3.0
"""Evidence of a mask that covers the predicted mask completely; its negative if the masks do not overlap."""

_OVERLAP_WEIGHT = 2.0
"""Evidence of equal masks, in addition to coverage."""

_SIMILARITY_WEIGHT, _NEUTRAL_SIMILARITY = 25.0, 0.88
"""Slope of the evidence over the similarity of histograms, and the similarity at which it is zero: histograms of one
person some frames apart are usually more similar, those of two people less."""

_MIN_APPEARANCE, _MAX_APPEARANCE = -4.0, 1.5
"""Bounds of the evidence of appearance: dark clothes look similar, and light and the visible part of a body change."""

_CLASS_CHANGE = -2.0
"""Evidence of a different class; it is small, because the class of an object can change between frames."""

_VACANCY_RATE, _MAX_VACANCY = 30.0, 6.0
"""Evidence against a track per second for which its predicted place was observed to be empty, and its upper bound."""


def position_log_ratio(squared_distance: Tensor, variance: Tensor) -> Tensor:
    """Log-likelihood ratio of positions, with a Student's t-distribution around the predicted position.

    Args:
        squared_distance: Squared distance between measured and predicted position, square metres, shape :math:`(*)`;
            NaN if a position is unknown.
        variance: Variance of each coordinate of the innovation, square metres, shape :math:`(*)`.

    Returns:
        Log-likelihood ratio, shape :math:`(*)`; 0 if a position is unknown.
    """
    exponent, variance = (_TAIL + 3) / 2, variance.clamp(max=_MAX_VARIANCE)
    constant = math.lgamma(exponent) - math.lgamma(_TAIL / 2) - 1.5 * math.log(_TAIL * math.pi)
    log_density = constant - 1.5 * variance.log() - exponent * (squared_distance / (variance * _TAIL)).log1p()
    return (math.log(_NEW_OBJECT_VOLUME) + log_density).nan_to_num(nan=0.0)


def overlap_log_ratio(coverage: Tensor, overlap: Tensor, visible: Tensor) -> Tensor:
    """Log-likelihood ratio of masks; never negative for an object that is hidden at its predicted position.

    Args:
        coverage: Intersection of instance and predicted mask, divided by the smaller area, shape :math:`(T, N)`.
        overlap: Intersection over union with the predicted or the last mask, shape :math:`(T, N)`.
        visible: Fraction of the predicted points whose depth is the measured depth, shape :math:`(T,)`; 0 if the
            predicted mask is empty.

    Returns:
        Log-likelihood ratio, shape :math:`(T, N)`.
    """
    # An object that is not visible at its predicted position can be elsewhere, so its mask is no evidence against an
    # instance.
    against = (2 * visible - 1).clamp(min=0)[:, None]
    weight = torch.where(coverage < 0.5, against, (2 * visible).clamp(max=1)[:, None])
    return _COVERAGE_WEIGHT * weight * (2 * coverage - 1) + _OVERLAP_WEIGHT * overlap


def appearance_log_ratio(similarity: Tensor) -> Tensor:
    """Log-likelihood ratio of appearances.

    Args:
        similarity: Similarity of the colour histograms, shape :math:`(*)`; NaN if one is unknown.

    Returns:
        Log-likelihood ratio, shape :math:`(*)`; 0 if an appearance is unknown.
    """
    evidence = _SIMILARITY_WEIGHT * (similarity - _NEUTRAL_SIMILARITY)
    return evidence.clamp(_MIN_APPEARANCE, _MAX_APPEARANCE).nan_to_num(nan=0.0)


def class_log_ratio(same_class: Tensor) -> Tensor:
    """Log-likelihood ratio of classes.

    Args:
        same_class: Mask of the pairs of the same class, bool, shape :math:`(*)`.
    """
    return torch.where(same_class, 0.0, _CLASS_CHANGE).to(torch.float64)


def vacancy_log_ratio(seconds: Tensor) -> Tensor:
    """Log-likelihood ratio of tracks whose predicted place is observed to be empty.

    Args:
        seconds: Time for which the place was observed to be empty, shape :math:`(*)`.
    """
    return -(_VACANCY_RATE * seconds).clamp(max=_MAX_VACANCY)
