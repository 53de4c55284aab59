"""Log-likelihood ratios: likelihood of an instance if it continues a track, relative to that of a new object.

Data association adds up the ratios of a pair, as in multiple hypothesis tracking (Blackman, 2004): position, overlap
of the masks, appearance, class and vacated places. Their sum for a pair is positive if the instance more likely
continues the track than is a new object.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_NEW_OBJECT_VOLUME = 10.0
"""Inverse density of new objects, cubic metres: about the volume that the camera observes."""

_DEGREES_OF_FREEDOM = 4.0
"""Degrees of freedom of Student's t-distribution of the innovations: some people turn or stop at once, and some masks
cover half of a person, so that large errors are more frequent than in a normal distribution."""

_MAX_VARIANCE = 1.0
"""Maximum variance of a coordinate, square metres: people who are out of view for seconds mostly stay in the room."""

_COVERAGE_WEIGHT = 3.0
"""Log ratio of a mask that covers the predicted mask completely; its negative if the masks do not overlap."""

_OVERLAP_WEIGHT = 2.0
"""Log ratio of equal masks, in addition to coverage."""

_OTHER_DISSIMILARITY = 0.21
"""Mean dissimilarity (1 - similarity) of the histograms of two people."""

_SAMPLING_DISSIMILARITY = 0.6
"""Mean dissimilarity of two histograms of one person in consecutive frames, times the square root of the number of
points of the smaller visible part: a histogram of few points is a small sample of the colours. All means were measured
on people with true masks."""

_DISSIMILARITY_RATE, _CHANGING_TIME = 0.05, 1.5
"""Increase of this mean per second while a person turns, and the time after which it does not increase further."""

_PARTIAL_DISSIMILARITY = 0.07
"""Increase of this mean if nearly nothing of the larger visible part is visible in the other frame, in proportion to
the hidden part: the legs have other colours than the whole person."""

_DISSIMILARITY_SHAPE = 2.0
"""Shape parameter of the gamma distributions of the dissimilarity."""

_MIN_APPEARANCE = -3.0
"""Lower bound of the log ratio of appearances: some masks cover a part of another person."""

_CLASS_CHANGE = -2.0
"""Log ratio of a different class; it is small, because the class of an object can change between frames."""

_VACATED_RATE, _MAX_VACATED = 30.0, 6.0
"""Decrease of the log ratio per second for which the predicted place was observed to be empty, and its maximum."""

_RADIUS = 0.3
"""Horizontal radius of a person, metres."""


def position_log_ratio(squared_distance: Tensor, variance: Tensor) -> Tensor:
    """Log-likelihood ratio of positions, with a Student's t-distribution around the predicted position.

    Args:
        squared_distance: Squared distance between measured and predicted position, square metres, shape :math:`(*)`;
            NaN if a position is unknown.
        variance: Variance of each coordinate of the innovation, square metres, shape :math:`(*)`.

    Returns:
        Log-likelihood ratio, shape :math:`(*)`; 0 if a position is unknown.
    """
    exponent, variance = (_DEGREES_OF_FREEDOM + 3) / 2, variance.clamp(max=_MAX_VARIANCE)
    constant = (
        math.lgamma(exponent) - math.lgamma(_DEGREES_OF_FREEDOM / 2) - 1.5 * math.log(_DEGREES_OF_FREEDOM * math.pi)
    )
    log_density = (
        constant - 1.5 * variance.log() - exponent * (squared_distance / (variance * _DEGREES_OF_FREEDOM)).log1p()
    )
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


def appearance_log_ratio(similarity: Tensor, elapsed: Tensor, fewer: Tensor, more: Tensor) -> Tensor:
    """Log-likelihood ratio of appearances, with gamma distributions of the dissimilarity of histograms.

    Args:
        similarity: Similarity of the colour histograms, shape :math:`(*)`; NaN if one is unknown.
        elapsed: Time between the two detections, seconds, shape :math:`(*)`.
        fewer: Number of points of the smaller visible part of the object, shape :math:`(*)`.
        more: Number of points of the larger one, shape :math:`(*)`.

    Returns:
        Log-likelihood ratio, shape :math:`(*)`; 0 if an appearance is unknown.
    """
    mean = (
        _SAMPLING_DISSIMILARITY * fewer.clamp(min=1).rsqrt()
        + _DISSIMILARITY_RATE * elapsed.clamp(max=_CHANGING_TIME)
        + _PARTIAL_DISSIMILARITY * (1 - fewer / more.clamp(min=1))
    )
    log_ratio = (_OTHER_DISSIMILARITY / mean).log() - (1 - similarity) * (1 / mean - 1 / _OTHER_DISSIMILARITY)
    return (_DISSIMILARITY_SHAPE * log_ratio).clamp(min=_MIN_APPEARANCE).nan_to_num(nan=0.0)


def class_log_ratio(same_class: Tensor) -> Tensor:
    """Log-likelihood ratio of classes.

    Args:
        same_class: Mask of the pairs of the same class, bool, shape :math:`(*)`.
    """
    return torch.where(same_class, 0.0, _CLASS_CHANGE).to(torch.float64)


def vacated_log_ratio(seconds: float, variance: float) -> float:
    """Log-likelihood ratio of a track whose predicted place is observed to be empty.

    Args:
        seconds: Time for which the place was observed to be empty.
        variance: Variance of each coordinate of the motion since the last detection, square metres.
    """
    # The place is empty as well if the object has moved by more than its radius. The probability of this, for a normal
    # distribution in two dimensions, limits the log ratio, however long the place has been empty.
    return -min(_VACATED_RATE * seconds, _MAX_VACATED, _RADIUS**2 / (2 * variance))
