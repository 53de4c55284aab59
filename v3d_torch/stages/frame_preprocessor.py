"""Preprocessing of frames: segmentation, re-estimation of depth, and features."""

from __future__ import annotations

import torch

from v3d_torch.config import Config
from v3d_torch.features.orb import ORB
from v3d_torch.frame_result import Extraction, PreprocessedFrame, Segmentation
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_smoother import DepthSmoother
from v3d_torch.runtime.input_checks import check_frame, check_instances, check_parameters
from v3d_torch.runtime.stage_timer import StageTimer
from v3d_torch.segmentation import make_segmenter
from v3d_torch.segmentation.coco import LABELS
from v3d_torch.segmentation.segmenter import segment_frame, segmenter_state_of, without_empty_masks
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.stages.protocols import DepthStage, FeatureStage
from v3d_torch.stages.replaceable_stages import ReplaceableStages
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import RGBDFrame, Segmenter

PREFETCHED_FRAMES = 4
"""Number of frames that are preprocessed ahead: a frame that becomes a keyframe takes twice as long to track as others,
and preprocessing continues meanwhile."""


class FramePreprocessor(ReplaceableStages):
    """Base class of `V3DSLAM`: the stages that can run ahead of tracking.

    They depend on the frame, and on a pose of the camera that was predicted some frames before. The state of tracking
    is neither read nor changed. `segment_instances` and `extract_features` are independent of each other and can run in
    different threads.

    Args:
        camera: Camera of all frames.
        segment: Segmenter; None to create the one named in the configuration. An `UprightSegmenter` is replaced by a
            new one around the same network, because it accumulates votes over the frames of one system.
        config: Configuration of all stages; None for the default.

    Attributes:
        camera: Camera of all frames.
        config: Configuration of all stages.

    Raises:
        WeightsError: If the weights of the network are not available.
        ConfigError: If a parameter has the wrong type.
        InputError: If the lens model of the camera maps no ray in front of the camera to some pixels.
    """

    def __init__(self, camera: PinholeCamera, segment: Segmenter | None, config: Config | None) -> None:
        check_parameters(camera, segment, config)
        super().__init__()
        self.camera = camera
        self.config = config = config or Config()
        if segment is not None and segment.__class__ is UprightSegmenter:
            segment = UprightSegmenter(segment.wrapped)  # its votes belong to one system
        self.segment = make_segmenter(config, camera) if segment is None else segment
        self.smooth_depth: DepthStage = DepthSmoother(
            config.depth.kernel_size, config.depth.sigma, config.depth.edge_ratio
        )
        self.detect_features: FeatureStage = ORB(config.features, camera)
        self._last_segmented: int | None = None  # index of the frame

    def preprocess(self, frame: RGBDFrame, prediction: PosePrediction | None) -> PreprocessedFrame:
        """Check and segment a frame, re-estimate its depth, and detect its features.

        Args:
            frame: Next frame.
            prediction: See `segment_instances`.

        Returns:
            The frame with its depth, features and instances.

        Raises:
            InputError: If the frame is not valid or of another camera.
            ConfigError: If the segmenter did not return valid `Instances`.
        """
        self.check(frame)
        segmentation = self.segment_instances(frame, prediction)
        return PreprocessedFrame(frame, self.extract_features(frame), lambda: segmentation)

    def check(self, frame: RGBDFrame) -> None:
        """Check that a frame is valid and of this camera; `preprocess` does this first.

        Raises:
            InputError: If the frame is not valid or of another camera.
        """
        check_frame(frame, self.camera)

    @torch.no_grad()
    def segment_instances(
        self, frame: RGBDFrame, prediction: PosePrediction | None, is_due: bool | None = None
    ) -> Segmentation:
        """Find the instances of a frame (III-A); those without pixels are left out.

        Args:
            frame: Frame; frames are segmented in their order, because a segmenter can have state.
            prediction: Pose prediction after an earlier frame, from which the segmenter computes the roll of the
                camera; None if the pose is not known.
            is_due: True to segment the frame, False to skip it; None to segment the first frame, and then one of
                ``segmentation.interval`` frames.

        Raises:
            ConfigError: If the segmenter did not return valid `Instances`.
        """
        if is_due is None:
            last = self._last_segmented
            is_due = last is None or not 0 < frame.index - last < self.config.segmentation.interval
        if is_due:
            self._last_segmented = frame.index
        timer = StageTimer()
        with timer("segmentation"):
            instances = None
            if is_due:
                T_cw = None if prediction is None else prediction.pose_at(frame.stamp)
                instances = segment_frame(self.segment, frame, T_cw)
                check_instances(instances, frame, LABELS)
                instances = without_empty_masks(instances)
        up_votes = self.segment.up_votes if isinstance(self.segment, UprightSegmenter) else None
        return Segmentation(instances, segmenter_state_of(self.segment), timer.times, up_votes)

    @torch.no_grad()
    def extract_features(self, frame: RGBDFrame) -> Extraction:
        """Re-estimate the depth of a frame (III-B.1), and detect its ORB features (III-A)."""
        timer = StageTimer()
        with timer("depth"):
            depth = self.smooth_depth(frame.depth[None])[0]
        with timer("features"):
            features = self.detect_features(frame.image, depth)
        return Extraction(depth, features, timer.times)
