"""Up direction of the world, from measured gravity, from people and objects, or from the first camera."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from v3d_torch.errors import InputError

_GRAVITY_TOLERANCE = math.radians(5)
"""Error of an accelerometer's up direction: bias and acceleration of a camera that is moved by hand."""

_IMAGE_TOLERANCE = math.radians(50)
"""Error of an up direction that is known only to a quarter turn of the image: the camera can look up or down, or be
rolled, by less than this. The normals of walls are then farther from the direction than the normal of the floor."""

_MIN_VOTES = 3.0
"""Minimum length of the sum of votes to be more reliable than the first camera, in detections of score 1."""


class UpDirection(NamedTuple):
    """Approximate up direction.

    Attributes:
        direction: Unit vector, world frame, float64, shape :math:`(3,)`.
        tolerance: Bound of its error, radians.
    """

    direction: Tensor
    tolerance: float


def estimate_up(gravity: Tensor | None = None, votes: Tensor | None = None) -> UpDirection:
    """Choose the most accurate source of the up direction. The floor then refines it, see `find_floor`.

    Args:
        gravity: Measured direction of gravity, world frame, shape :math:`(3,)`; None if it is not measured.
        votes: Sum of the votes of the segmentation for the up direction, world frame, shape :math:`(3,)`; see
            `UprightSegmenter`. None if there are none.

    Returns:
        Up direction with a bound of its error; that of the first image if neither source is available.

    Raises:
        InputError: If the gravity is not a vector of 3 finite numbers, or zero.
    """
    if gravity is not None:
        if gravity.shape != (3,) or not 0 < float(gravity.to(torch.float64).norm()) < math.inf:
            raise InputError(f"gravity is {gravity.tolist()}; give a vector of 3 numbers, not zero")
        return UpDirection(-normalize(gravity.to(torch.float64), dim=0), _GRAVITY_TOLERANCE)
    if votes is not None and float(votes.norm()) >= _MIN_VOTES:
        return UpDirection(normalize(votes.to(torch.float64), dim=0), _IMAGE_TOLERANCE)
    return UpDirection(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), _IMAGE_TOLERANCE)
