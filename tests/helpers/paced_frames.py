"""Live source without gaps: each frame comes as soon as the one before was tracked."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame


def paced(frames: Iterable[RGBDFrame], slam: V3DSLAM) -> Iterator[RGBDFrame]:
    """Yield frames to a live run of a system, each after the one before was tracked; rejected ones cause no wait."""
    newest = -float("inf")
    for frame in frames:
        yield frame
        newest = max(newest, frame.stamp)
        while slam.poses.stamp < newest:
            time.sleep(0.001)
