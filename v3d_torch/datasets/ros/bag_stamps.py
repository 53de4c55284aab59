"""Stamps of the messages of a topic: those of their headers, in increasing order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from v3d_torch.errors import InputError

_MAX_DROPPED_FRACTION = 0.1
"""Maximum fraction of the images of a topic that are dropped because the clock was set back. If more are, most of the
recording can have another clock than its first images."""


def index_by_stamp(
    path: Path, topic: str, stamps: Sequence[float], arrivals: Sequence[float]
) -> tuple[dict[float, int], str | None]:
    """Index the images of a topic by their stamps. Images from before the newest earlier image are dropped.

    Args:
        path: Path of the bag, for messages.
        topic: Topic of the images, for messages.
        stamps: Stamps in the headers, seconds, in the order of arrival; all are 0 if the headers are not filled in.
        arrivals: Times of arrival, seconds, which replace stamps that are all equal.

    Returns:
        Index of the image by stamp, increasing; and a sentence on the images that were dropped, or on stamps that are
        all equal but not 0, None if there are neither.

    Raises:
        InputError: If more than a tenth of the images would be dropped.
    """
    note = None
    if len(set(stamps)) == 1:
        if any(stamps) and len(stamps) > 1:
            note = f"{topic}: all images have the stamp {stamps[0]:.6f} s; their times of arrival are used"
        stamps = arrivals
    indices: dict[float, int] = {}
    newest, dropped = -math.inf, []
    for index, stamp in enumerate(stamps):
        if stamp > newest:
            indices[stamp] = index
            newest = stamp
        elif stamp < newest:  # an equal stamp is that of an image that was published twice
            dropped.append(index)
    if not dropped:
        return indices, note
    first = dropped[0]
    jump = f"the stamps jump back from {stamps[first - 1]:.6f} to {stamps[first]:.6f} s after {first} images"
    count = f"{len(dropped)} of {len(stamps)} images"
    if len(dropped) > _MAX_DROPPED_FRACTION * len(stamps):
        raise InputError(
            f"{path}: {topic}: {jump}, and {count} are from before an earlier image; cut the bag there, or record it"
            " again with a clock that is not set"
        )
    return indices, f"{topic}: {jump}; {count} are left out"


def header_stamp(message: Any) -> float:
    """Return the stamp in the header of a message, seconds."""
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec * 1e-9)
