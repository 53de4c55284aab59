"""Live source without gaps: each frame comes as soon as the one before was tracked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from helpers.waiting import wait_until
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame


def paced(frames: Iterable[RGBDFrame], slam: V3DSLAM) -> Iterator[RGBDFrame]:
    """Yield frames to a live run of a system, each after the one before was tracked; rejected ones cause no wait."""
    newest = -float("inf")
    for frame in frames:
        yield frame
        newest = max(newest, frame.stamp)
        wait_until(lambda: slam.poses.stamp >= newest, 120, f"the frame at {newest} s was tracked")  # noqa: B023
