"""Check of the order of the colour channels, by the scores of the segmentation network.

A network that was trained on photographs has lower scores if red and blue are exchanged. On a few images, the sum of
its scores is compared with that of the same images with red and blue exchanged.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.segmentation.segmenter import innermost_segmenter
from v3d_torch.segmentation.yolo import YOLOSegmenter
from v3d_torch.types import Segmenter

_FIRST_IMAGES = 2
"""Number of images that are compared first. To save time, further images are compared only if these seem exchanged."""

_IMAGES = 12
"""Maximum number of images that are compared."""

_MIN_RATIO = 1.1
"""Minimum ratio of the scores with exchanged channels to those without, for a warning."""

_MIN_T = 2.5
"""Minimum t-statistic of the difference of the scores, for a warning."""


def check_colour_order(views: StaticViews, segment: Segmenter) -> list[str]:
    """Check whether the scores of the network are higher if red and blue are exchanged.

    Args:
        views: Static views of the keyframes.
        segment: Segmenter of the run; only a YOLO network is used.

    Returns:
        A list with one sentence that states the likely cause, or an empty list.
    """
    network = innermost_segmenter(segment)
    if not isinstance(network, YOLOSegmenter) or len(views) < _FIRST_IMAGES:
        return []
    images = [view.colour for view in views]
    count = min(_IMAGES, len(images))
    spread = [images[round(index)] for index in torch.linspace(0, len(images) - 1, count).tolist()]
    spread = spread[::2] + spread[1::2]  # so that the first images are spread over the run, too
    first = _compare_scores(spread[:_FIRST_IMAGES], network)
    if float(first[:, 0].sum()) >= float(first[:, 1].sum()):
        return []
    scores = torch.cat([first, _compare_scores(spread[_FIRST_IMAGES:], network)])
    difference = scores[:, 1] - scores[:, 0]
    error = (difference.std() / math.sqrt(len(difference))).clamp(min=1e-9)
    if difference.mean() < _MIN_T * error or scores[:, 1].sum() < _MIN_RATIO * scores[:, 0].sum():
        return []
    return [
        "the network detects more objects in the images if red and blue are exchanged; the colour images seem to be BGR"
        " instead of RGB"
    ]


def _compare_scores(images: list[Tensor], network: YOLOSegmenter) -> Tensor:
    """Sum of the scores of each image, and of the same image with exchanged channels, (N, 2)."""
    pairs = [[network.segment(each).scores.sum() for each in (image, image.flip(0))] for image in images]
    return torch.tensor(pairs, dtype=torch.float64).reshape(-1, 2)
