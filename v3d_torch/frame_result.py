"""Data of one frame before and after tracking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import Instances, RGBDFrame


@dataclass(frozen=True)
class Segmentation:
    """Result of `V3DSLAM.segment_instances`.

    Attributes:
        instances: Instances of the frame; None if the frame was not segmented.
        segmenter_state: State of the segmenter after this frame; None if it has no state.
        times: Time that each stage took.
        up_votes: Votes for the up direction after this frame, see `UprightSegmenter.up_votes`; None if the segmenter is
            another one.
    """

    instances: Instances | None
    segmenter_state: dict[str, Any] | None
    times: dict[str, StageTime]
    up_votes: Tensor | None = None


@dataclass(frozen=True)
class Extraction:
    """Result of `V3DSLAM.extract_features`.

    Attributes:
        depth: Re-estimated depth, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        features: Features of the whole image.
        times: Time that each stage took.
    """

    depth: Tensor
    features: Features
    times: dict[str, StageTime]


@dataclass(frozen=True)
class PreprocessedFrame:
    """Result of `V3DSLAM.preprocess`: everything that is computed before tracking.

    Attributes:
        frame: Frame.
        extraction: Depth and features of the frame.
        wait_for_segmentation: Function that returns the segmentation when it is complete.
        read_times: Time that reading the frame took, by stage; empty if it was not measured.
    """

    frame: RGBDFrame
    extraction: Extraction
    wait_for_segmentation: Callable[[], Segmentation]
    read_times: dict[str, StageTime] = field(default_factory=dict)

    @property
    def times(self) -> dict[str, StageTime]:
        """Time of reading and of the extraction, by stage."""
        return {**self.read_times, **self.extraction.times}

    @property
    def segmentation(self) -> Segmentation:
        """Segmentation of the frame; waits until it is complete."""
        return self.wait_for_segmentation()


@dataclass(frozen=True, kw_only=True)
class FrameResult(FrameObjects, CameraState):
    """Result of `V3DSLAM.track`: the objects of a frame, and the state of the camera as it was known then.

    Later corrections of the pose are in `V3DSLAM.poses`.

    It has the attributes of `CameraState`, those of `FrameObjects`, and one of its own.

    Attributes:
        T_dc: Motion of the camera from the time of the colour image to that of the depth image: it maps points of the
            camera frame "c" at the former to "d" at the latter, float64, shape :math:`(4, 4)`.
    """

    T_dc: Tensor
