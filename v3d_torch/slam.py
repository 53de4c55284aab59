"""V3D-SLAM: the processing of one frame by all stages."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import partial
from typing import Any, NoReturn

import torch
from torch import Tensor

from v3d_torch.backend.back_end import BackEnd
from v3d_torch.backend.loop_closer import LoopCloser
from v3d_torch.config import Config
from v3d_torch.errors import ConfigError
from v3d_torch.features.features import Features
from v3d_torch.frame_result import FrameResult, PreprocessedFrame, Segmentation
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, orthonormalise, se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.landmark_ids import compact_landmarks
from v3d_torch.mapping.mapper import Mapper
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.objects.appearance import colour_histograms
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.feature_support import FeatureSupport
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.objects.free_space_check import FreeSpaceCheck
from v3d_torch.objects.image_scale import scale_to_image
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.objects.motion_classifier import MotionClassifier
from v3d_torch.objects.unlabelled import unlabelled_instances
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_mapper import OccupancyMapper
from v3d_torch.occupancy.up_estimator import UpEstimator
from v3d_torch.odometry.motion_estimator import MotionEstimator
from v3d_torch.odometry.odometry import CameraMotion, Odometry, TrackedFrame
from v3d_torch.odometry.time_compensation import TimeCompensation
from v3d_torch.runtime.inference_mode import mode_to_update
from v3d_torch.runtime.input_checks import check_next
from v3d_torch.runtime.stage_timer import StageTimer
from v3d_torch.runtime.stateful import Stateful
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.segmentation.segmenter import (
    innermost_segmenter,
    restore_segmenter,
    segmenter_state_of,
    without_empty_masks,
)
from v3d_torch.stages.frame_preprocessor import PREFETCHED_FRAMES, FramePreprocessor
from v3d_torch.stages.protocols import (
    AppearanceStage,
    BackProjectionStage,
    CompensationStage,
    OdometryStage,
    ProposalStage,
)
from v3d_torch.stages.replaceable_stages import require_state
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.tracking.camera_tracker import CameraTracker
from v3d_torch.tracking.map_tracker import MapTracker
from v3d_torch.tracking.motion_model import MotionModel, PosePrediction
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.tracking.previous_frame import PreviousFrameRefinement
from v3d_torch.tracking.state_estimator import StateEstimator
from v3d_torch.tracking.state_history import StateHistory
from v3d_torch.types import FramePose, Instances, RGBDFrame, Segmenter, TrackingStatus

_STATEFUL = (
    "timer", "map", "poses", "estimate_state", "states", "motion_model", "free_space_check", "classify_motion",
    "mapper", "loop_closer", "back_end", "occupancy", "up_estimator",
)  # fmt: skip
"""Names of the attributes with state that changes from frame to frame."""

_OBJECT_STAGES = "free_space_check", "back_project_instances", "describe_appearance", "classify_motion"
"""Names of the stages that find and classify objects."""


class V3DSLAM(FramePreprocessor):
    """Tracks an RGB-D camera, maps the static scene and classifies the motion of objects.

    `preprocess` runs the stages that can run ahead of tracking, see `FramePreprocessor`; `track` runs the others. Every
    stage is an attribute. All but `estimate_motion`, `track_map` and `loop_closer`, which other stages call, can be
    replaced by an object with the same methods; results of replaced stages are checked where other stages use them.
    Hooks get the arguments and results of stages, see `register_stage_hook`.

    Args:
        camera: Camera of all frames.
        segment: Segmenter; None to create the one named in the configuration. An `UprightSegmenter` is replaced by a
            new one around the same network, because it accumulates votes over the frames of one system.
        config: Configuration of all stages; None for the default.
        known_map: Map of an earlier run in which the camera is localised, see `load_map`; None to start a new map. The
            system extends this map itself, not a copy: load it again for another run.

    Attributes:
        camera: Camera of all frames.
        config: Configuration of all stages.
        map: Keyframes and landmarks.
        poses: Poses of all frames.
        states: States of the camera in the last 10 seconds.
        occupancy: Occupancy mapping, with the map in ``occupancy.map``; None unless ``occupancy.enabled`` is set.
        predictions: Pose predictions with which the next `PREFETCHED_FRAMES` frames are preprocessed.
        timer: Time of each stage.

    Raises:
        WeightsError: If the weights of the network are not available.
        ConfigError: If a parameter has the wrong type, the known map is of another camera or configuration, or a stage
            that the configuration names by its import path cannot be made, see `StagesConfig`.
        InputError: If the lens model of the camera maps no ray in front of the camera to some pixels.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        segment: Segmenter | None = None,
        config: Config | None = None,
        known_map: SparseMap | None = None,
    ) -> None:
        super().__init__(camera, segment, config)
        if not isinstance(known_map, SparseMap | None):
            raise ConfigError(f"V3DSLAM needs a SparseMap, got a {type(known_map).__name__}; give load_map(...).map")
        if known_map is not None and known_map.camera != camera:
            raise ConfigError("the known map was loaded for another camera; load it with the camera of the frames")
        config = self.config
        if known_map is not None and (known_map.config, known_map.features_config) != (config.mapping, config.features):
            raise ConfigError(
                "the known map was loaded with other values in the sections mapping or features; load it with the"
                " configuration of the system"
            )
        self.timer = StageTimer()
        self.map = SparseMap.empty(config, camera) if known_map is None else known_map
        self.poses = PoseHistory()
        self.motion_model = MotionModel()
        # Motion of the camera since the previous frame
        self.compensate: CompensationStage = TimeCompensation(config, camera)
        self.estimate_motion = MotionEstimator(config.odometry, config.features, camera, config.seed)
        self.odometry: OdometryStage = Odometry(config, camera, self.estimate_motion)
        # Objects
        objects = scale_to_image(config.objects, camera)
        free_space = objects.free_space
        self.free_space_check = FreeSpaceCheck(free_space, camera)
        self.propose_unlabelled: ProposalStage = partial(
            unlabelled_instances, camera=camera, min_area=free_space.min_unlabelled_area
        )
        self.back_project_instances: BackProjectionStage = InstanceBackProjector(objects.clouds, camera)
        self.describe_appearance: AppearanceStage = colour_histograms
        self.classify_motion = MotionClassifier(objects, camera)
        # Camera pose and map
        local_keyframes = config.tracking.local_keyframes
        self.track_map = MapTracker(config.tracking, config.features, camera)
        self.loop_closer = LoopCloser(config.loop, self.estimate_motion, self.track_map, local_keyframes)
        self.track_camera = CameraTracker(self.track_map, self.loop_closer, self.map, local_keyframes)
        self.refine_previous = PreviousFrameRefinement(
            self.track_map, self.map, refine_pose=config.rolling_shutter.enabled
        )
        self.estimate_state = StateEstimator()
        self.states = StateHistory()
        self.mapper = Mapper(config, camera, self.map)
        self.back_end = BackEnd(config, camera, self.map, self.loop_closer)
        self.loop_closer.rebuild_database(self.map.active_keyframes)
        # Free and occupied space
        self.occupancy = OccupancyMapper(config.occupancy, camera) if config.occupancy.enabled else None
        self.up_estimator = UpEstimator()
        self._replace_configured(config, camera)
        self._previous: TrackedFrame | None = None
        self._last_segmented_tracked: int | None = None  # index; preprocessing can be some frames ahead
        self.predictions = deque([self._predict()] * PREFETCHED_FRAMES)

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute, see `ReplaceableStages`; the state of a new segmenter replaces that of the one before."""
        super().__setattr__(name, value)
        if name == "segment":
            self._segmenter_state = segmenter_state_of(value)

    def __reduce__(self) -> NoReturn:
        """Raise TypeError: a system cannot be pickled or copied, but its state can be saved, see `save_state`."""
        raise TypeError("V3DSLAM cannot be pickled or copied; use save_state, and load_state with a new V3DSLAM")

    @property
    def gravity(self) -> Tensor | None:
        """Measured direction of gravity, a unit vector, world frame, float64, shape :math:`(3,)`; None if unknown."""
        return self.up_estimator.gravity

    @property
    def up(self) -> Tensor:
        """Direction against gravity as it is known now, unit vector, world frame, float64, shape :math:`(3,)`.

        It comes from measured gravity, else from the floor in the occupancy map, else from the segmentation, else from
        the first image. Boxes of objects need it: ``result.boxes(slam.up)``.
        """
        return self.up_estimator.up(self._floor)

    @property
    def T_lw(self) -> Tensor | None:
        """Transform from the world to the level frame, see `level_frame`, float64, shape :math:`(4, 4)`.

        Up is against the measured gravity; without a measurement it is the normal of the floor in the occupancy map,
        and follows it. None while neither is known.
        """
        return self.up_estimator.T_lw(self._floor)

    @property
    def _proposes_objects(self) -> bool:
        """True if moving regions without a class become objects: not in the baseline without masks."""
        return self.config.segmentation.source != "none"

    @property
    def _has_objects(self) -> bool:
        """True if the object stages are called: not in the baseline without masks, where they would find nothing.

        Even there they are called if one of them was replaced, or has a hook.
        """
        finds_instances = not isinstance(innermost_segmenter(self.segment), NoSegmentation)
        return self._proposes_objects or finds_instances or self._is_changed(*_OBJECT_STAGES)

    @property
    def _floor(self) -> Floor | None:
        return None if self.occupancy is None else self.occupancy.floor

    def __call__(self, frame: RGBDFrame) -> FrameResult:
        """Process the next frame: preprocess and track.

        Args:
            frame: Next frame, later than the previous one.

        Returns:
            Result of `track`.

        Raises:
            InputError: If the frame is not valid, of another camera, or not later than the previous one.
            ConfigError: If the segmenter did not return valid `Instances`.
        """
        self.check(frame)
        check_next(frame, self.poses.stamp)  # before the frame is segmented, because the segmenter can have state
        preprocessed = self.preprocess(frame, self.predictions[0])
        self.advance_predictions()
        return self.track(preprocessed)

    @torch.no_grad()
    def track(self, preprocessed: PreprocessedFrame) -> FrameResult:
        """Track the camera and the objects in the next frame, and extend the map.

        Args:
            preprocessed: Result of `preprocess` for the next frame.

        Returns:
            Objects of the frame, and state of the camera as it is known now. Poses that later frames correct are in
            ``poses``.

        Raises:
            InputError: If the frame is not later than the previous one, or the depth of the first frame is not in
                metres.
        """
        with mode_to_update(self._updated_tensors()):
            return self._track(preprocessed)

    def _track(self, preprocessed: PreprocessedFrame) -> FrameResult:
        frame, depth = preprocessed.frame, preprocessed.extraction.depth
        check_next(frame, self.poses.stamp)
        self.timer.add(preprocessed.times)
        with self.timer("odometry"):  # III-E: camera motion since the previous frame, from its static pixels
            prediction = self.motion_model.predict(self.poses)
            T_cp, velocity = prediction.motion_until(frame.stamp), prediction.velocity_at(frame.stamp)
            features = self._compensate(preprocessed.extraction.features, preprocessed, velocity)
            motion = self.odometry(self._previous, TrackedFrame(frame, depth, features), T_cp, velocity)
            self.states.append_motion(frame.stamp, motion)  # for `pose_at` in other threads
        is_delayed = self.config.rolling_shutter.enabled  # else colour and depth count as simultaneous
        delay = frame.depth_delay + self.camera.depth_delay if is_delayed else 0.0
        T_dc = se3_exp(motion.velocity * delay)  # from the time of the colour image to that of the depth image
        objects, view = self._track_objects(preprocessed, features, motion, T_dc)  # III-A to III-D
        self.flush()  # III-E: bundle adjustment, loops and pose graph, solved since the last keyframe
        with self.timer("tracking"):  # III-E: camera pose in the local map, from static features
            is_static = features.in_mask(objects.static_mask)
            static = self._compensate(preprocessed.extraction.features[is_static], preprocessed, motion.velocity)
            propagated = motion.propagate_landmarks(self._previous, len(features))[is_static]
            previous_velocity = self.motion_model.previous_velocity(self.poses, motion)
            self.refine_previous(self._previous, previous_velocity, self.poses, self.compensate)
            pose = self.track_camera(static, depth, self._compose_pose(motion), propagated, motion, self.poses)
            self.motion_model.update(self.poses, frame.stamp, pose, motion)
        with self.timer("mapping"):  # III-E: keyframes and landmarks
            reference = self.track_camera.reference_keyframe(pose, self.poses)
            keyframe = self.mapper(frame, static, pose, reference)
            self._append_pose(frame, pose, motion, reference, keyframe)
            if keyframe is not None:
                self.back_end.submit(keyframe)
            if view is not None and pose.status is not TrackingStatus.LOST:
                T_dw = T_dc @ self.poses.T_cw
                self.free_space_check.add_view(view, T_dw)
                self.classify_motion.add_view(view, T_dw, objects.map_mask)
            landmarks = pose.landmarks if keyframe is None else keyframe.landmarks
            self._previous = TrackedFrame(frame, depth, static, objects.static_mask, landmarks)
        with self.timer("tracking"):  # covariance of the pose, twist of the camera
            owners = self.map.landmarks["keyframe"][pose.observed_landmarks]
            references = None if keyframe is None else self.map.references
            state = self.estimate_state(pose, motion, self.poses, owners, references)
            self.states.append(state)
        if self.occupancy is not None:
            with self.timer("occupancy"):  # space that static surfaces occupy, and free space in front of them
                self.occupancy(depth, objects.static_mask, self.poses, self.up_estimator.estimate(), T_dc)
        # The world frame can have been corrected after the objects were tracked.
        objects = self.classify_motion.correct_result(objects)
        parts = (objects, FrameObjects), (state, CameraState)  # a stage can return a subclass with other attributes
        values = {each.name: getattr(part, each.name) for part, kind in parts for each in fields(kind)}
        return FrameResult(**values, T_dc=T_dc)

    def _track_objects(
        self, preprocessed: PreprocessedFrame, features: Features, motion: CameraMotion, T_dc: Tensor
    ) -> tuple[FrameObjects, DepthView | None]:
        """Track the objects of a frame and classify their motion.

        Args:
            preprocessed: The frame.
            features: Its features, compensated.
            motion: Motion of the camera since the previous frame.
            T_dc: Motion of the camera from the time of the colour image to that of the depth image, float64, (4, 4).

        Returns:
            Objects and static mask, and the view for the free-space check; no objects and None in the baseline without
            masks.
        """
        frame, depth = preprocessed.frame, preprocessed.extraction.depth
        if not self._has_objects:
            self._take_segmentation(preprocessed)
            return FrameObjects.empty(*depth.shape[-2:]), None
        with self.timer("free_space"):  # not in the paper: surfaces that contradict a static scene
            was_lost = self.poses.status is TrackingStatus.LOST
            T_dw = T_dc @ self._compose_pose(motion)
            view = self.free_space_check.make_view(frame.stamp, depth, T_dw, is_motion_measured=motion.is_measured)
            appeared_pixels = self.free_space_check(view, pose_known=motion.is_measured and not was_lost)
        segmentation = self._take_segmentation(preprocessed)  # III-A
        with self.timer("free_space"):
            instances = self._complete_instances(segmentation.instances, view, appeared_pixels)
        with self.timer("clouds"):  # III-B.2: instance clouds without outliers
            clouds = self.back_project_instances(depth, instances)
            # The ids of propagated instances are known without a comparison.
            is_compared = self.config.objects.tracker.compare_appearance and instances.track_ids is None
            appearance = self.describe_appearance(frame.image, clouds.cloud_pixels) if is_compared else None
        with self.timer("objects"):  # III-C, III-D: ids, Hough voting, Chamfer distance, static mask
            residuals = motion.residuals(self._previous, features, self.camera)
            support = FeatureSupport(features.pixel, motion.inlier_mask(len(features)), residuals)
            return self.classify_motion(instances, clouds, view, appeared_pixels, support, appearance), view

    def flush(self) -> None:
        """Apply the pending result of the back end. `track` does this in every frame; call it after the last frame."""
        result = self.back_end.result()
        if result is None:
            return
        self.timer.add(result.times)
        with self.timer("mapping"), mode_to_update(self._updated_tensors()):
            self._apply_world_correction(self.back_end.apply(result))
            compact_landmarks(self.map, self._landmarks_outside_of_map())

    def advance_predictions(self) -> PosePrediction | None:
        """Append the prediction for the frame after the next `PREFETCHED_FRAMES`, and return it.

        Call this before each call of `track`. The predictions, and so the results, are then the same whether frames are
        preprocessed ahead or not.
        """
        self.predictions.popleft()
        self.predictions.append(self._predict())
        return self.predictions[-1]

    def pose_at(self, stamp: float) -> CameraState:
        """Return the state of the camera at a time: interpolated between frames, predicted after the last one.

        It can be called from another thread while frames are tracked.

        Args:
            stamp: Time in the clock of the frames, seconds, from 10 s before the last frame to a day after it.

        Raises:
            InputError: If the time is earlier, later or not finite, or no frame has been tracked.
        """
        return self.states.at(stamp)

    def state_dict(self) -> dict[str, Any]:
        """Return the state that changes from frame to frame. Call it between two frames.

        The state shares its objects with the system: write it, or copy it with ``copy.deepcopy``, before the next
        frame. `save_state` writes it to a file.

        Raises:
            ConfigError: If a stage was replaced by one without state_dict.
        """
        own = {
            "camera": asdict(self.camera),
            "previous": self._previous,
            "predictions": list(self.predictions),
            "segmenter": self._segmenter_state,
            "last_segmented": self._last_segmented_tracked,
        }
        return {**{name: each.state_dict() for name, each in self._components_with_state().items()}, **own}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`; the results of the next frames are the same as without an interruption.

        The objects of the state are shared, not copied.

        Raises:
            ConfigError: If the state lacks a part or has another one, for example because it was saved without or with
                an occupancy map, if it is of another camera, or if the segmenter cannot load its state.
        """
        own = self.state_dict().keys()
        for verb, names in (("lacks", own - state.keys()), ("has", state.keys() - own)):
            if names:
                raise ConfigError(
                    f"the state {verb} {', '.join(sorted(names))}; load it with the configuration of its system"
                )
        if PinholeCamera(**state["camera"]) != self.camera:
            raise ConfigError("the state is of another camera; load it into a system with the camera of its frames")
        self.back_end.discard()  # it reads the map
        for name, component in self._components_with_state().items():
            component.load_state_dict(state[name])
        self._previous, self._segmenter_state = state["previous"], state["segmenter"]
        self._last_segmented = self._last_segmented_tracked = state["last_segmented"]
        self.predictions = deque(state["predictions"])
        restore_segmenter(self.segment, self._segmenter_state)

    def _components_with_state(self) -> dict[str, Stateful]:
        components = {name: getattr(self, name) for name in _STATEFUL}
        return {name: require_state(name, each) for name, each in components.items() if each is not None}

    def _updated_tensors(self) -> list[Tensor]:
        """Oldest and newest tensors that are updated in place; they show whether any was made in inference mode."""
        newest = [keyframe.landmarks for keyframe in self.map.keyframes[-1:]]
        return [self.map.landmarks["point"], *newest, *self._landmarks_outside_of_map()]

    def _landmarks_outside_of_map(self) -> list[Tensor]:
        """Landmark ids stored outside of the map, -1 for none, int64, updated in place when the map is compacted."""
        previous = None if self._previous is None else self._previous.landmarks
        return [self.poses.observed_landmarks] if previous is None else [self.poses.observed_landmarks, previous]

    def _compensate(self, features: Features, preprocessed: PreprocessedFrame, velocity: Tensor) -> Features:
        """Move features to where they would be without rolling shutter and depth delay, see `TimeCompensation`."""
        depth, delay = preprocessed.extraction.depth, preprocessed.frame.depth_delay
        return self.compensate(features, depth, delay, velocity, self.map.readout)

    def _compose_pose(self, motion: CameraMotion) -> Tensor:
        """Compose the pose of the previous frame with the motion since then: world to camera, float64, (4, 4)."""
        return orthonormalise(motion.T_cp @ self.poses.T_cw)

    def _take_segmentation(self, preprocessed: PreprocessedFrame) -> Segmentation:
        """Wait for the segmentation, store the state of the segmenter and its up votes, and return it.

        Until then, the network can run in parallel to other stages.
        """
        segmentation = preprocessed.segmentation
        self._segmenter_state = segmentation.segmenter_state
        if segmentation.instances is not None:
            self._last_segmented_tracked = preprocessed.frame.index
        self.up_estimator.votes = segmentation.up_votes
        self.timer.add(segmentation.times)
        return segmentation

    def _complete_instances(
        self, instances: Instances | None, view: DepthView, appeared_pixels: AppearedPixels
    ) -> Instances:
        """Propagate the masks of objects to a frame without segmentation, and add moving regions without a class."""
        if instances is None:
            instances = self.classify_motion.propagate_instances(view)
        if not self._proposes_objects:
            return instances
        proposed = self.propose_unlabelled(appeared_pixels, instances, view.depth)
        return instances.concatenate(without_empty_masks(proposed))

    def _append_pose(
        self,
        frame: RGBDFrame,
        pose: FramePose,
        motion: CameraMotion,
        reference: Keyframe | None,
        keyframe: Keyframe | None,
    ) -> None:
        """Append the pose of a frame, and move what is stored in the world frame if the frame defines a new one."""
        part, predicted_T_cw = self.poses.part, self._compose_pose(motion)  # with corrections since the objects
        T_new_old = self.poses.append(frame.stamp, pose, motion, reference, keyframe)
        self._apply_world_correction(T_new_old)
        guessed_T_cw = predicted_T_cw if T_new_old is None else predicted_T_cw @ invert(T_new_old)
        self._move_to_map(pose, guessed_T_cw, is_other_part=self.poses.part != part)
        is_pose_known = self.poses.is_localised or not self.poses.was_found  # until then, the world frame is temporary
        self.up_estimator.add_gravity(frame.gravity if is_pose_known else None, self.poses.T_cw, T_new_old)

    def _move_to_map(self, pose: FramePose, guessed_T_cw: Tensor, *, is_other_part: bool) -> None:
        """Move the objects of the frame from the pose with which they were tracked to the pose in the map.

        Args:
            pose: Pose of the frame.
            guessed_T_cw: Pose with which its objects were tracked, float64, shape (4, 4).
            is_other_part: True if the frame is in another part of the map than the frame before.
        """
        if is_other_part:  # the pose relative to the stored views is a guess
            self.free_space_check.drop_views()
            self.classify_motion.drop_views()
        if pose.status is not TrackingStatus.LOST or self.poses.is_localised:  # also the pose that starts the map
            self.classify_motion.move_to_map(invert(pose.T_cw) @ guessed_T_cw, all_tracks=is_other_part)

    def _predict(self) -> PosePrediction | None:
        """Predict the motion of the camera; None until the camera is found in a map of an earlier run."""
        is_new_map = not (self.map.keyframes and self.map.keyframes[0].is_from_earlier_run)
        return self.motion_model.predict(self.poses) if is_new_map or self.poses.was_found else None

    def _apply_world_correction(self, T_new_old: Tensor | None) -> None:
        """Apply a correction of the map to all other data that is stored in the world frame."""
        if T_new_old is not None:
            for each in (self.classify_motion, self.free_space_check, self.estimate_state, self.states):
                each.apply_world_correction(T_new_old)
