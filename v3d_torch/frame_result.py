"""Data of one frame before and after tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus


@dataclass(frozen=True)
class PreprocessedFrame:
    """Result of `V3DSLAM.preprocess`: everything that follows from the frame alone.

    Attributes:
        frame: Frame.
        instances: Instances of the segmentation; None if it leaves this frame out.
        depth: Re-estimated depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        features: Features of the whole image.
        times: Time that each stage took.
        segmenter_state: State of the segmenter after this frame; None if it has no state.
    """

    frame: RGBDFrame
    instances: Instances | None
    depth: Tensor
    features: Features
    times: dict[str, StageTime]
    segmenter_state: dict[str, Any] | None


@dataclass(frozen=True, kw_only=True)
class FrameResult(FrameObjects):
    """Result of `V3DSLAM.track`. Later corrections of the pose are in `V3DSLAM.poses`.

    Attributes:
        stamp: Timestamp, seconds.
        T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`; the world frame is that of the first camera.
        status: Source of the pose.
    """

    stamp: float
    T_wc: Tensor
    status: TrackingStatus
