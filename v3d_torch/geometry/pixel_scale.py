"""Scale of lengths in pixels that are given for the images of a Kinect."""

from __future__ import annotations

_COLUMNS = 640


def pixel_scale(columns: int) -> float:
    """Return the factor of lengths in pixels that are given for images of 640 columns.

    Args:
        columns: Number of columns of the images.
    """
    return columns / _COLUMNS
