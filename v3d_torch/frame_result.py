"""What is known of one frame: by itself, and once the camera has been followed to it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from v3d_torch.features.orb import Features
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus

PREFETCHED_FRAMES = 4
"""Frames that may be looked at before their turn: a frame that becomes a keyframe takes twice as long to take in as
others, and what looks at the frames goes on meanwhile. With 2 fr1_rpy takes 3 % longer."""


@dataclass(frozen=True, kw_only=True)
class FrameResult(FrameObjects):
    """What is known of a frame when it has been taken in. Later corrections of its pose are in `V3DSLAM.poses`.

    Attributes:
        stamp: seconds.
        T_wc: camera to world, float64, shape :math:`(4, 4)`; the world is the first frame's camera.
        status: how the pose was found.
    """

    stamp: float
    T_wc: Tensor
    status: TrackingStatus


@dataclass(frozen=True)
class PreprocessedFrame:
    """What a frame shows by itself, whatever was seen before.

    Attributes:
        frame: as it came.
        instances: that the segmentation finds.
        depth: re-estimated, metres, float32, shape :math:`(1, H, W)`.
        features: of the whole image.
        seconds: that each stage took.
        memory: of the segmentation after the frame, where it has one (`Remembering`).
    """

    frame: RGBDFrame
    instances: Instances
    depth: Tensor
    features: Features
    seconds: dict[str, float]
    memory: object
