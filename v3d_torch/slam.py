"""V3D-SLAM: the way of one frame, in the paper's order."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from v3d_torch.backend.back_end import BackEnd
from v3d_torch.backend.loop_closer import LoopCloser
from v3d_torch.config import Config
from v3d_torch.features.orb import ORB, Features
from v3d_torch.frame_result import PREFETCHED_FRAMES, FrameResult, PreprocessedFrame
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_smoother import DepthSmoother
from v3d_torch.geometry.se3 import invert, rigid
from v3d_torch.mapping.mapper import Mapper
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.objects.feature_support import FeatureSupport
from v3d_torch.objects.free_space_check import FreeSpaceCheck
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.objects.motion_classifier import MotionClassifier
from v3d_torch.objects.unlabelled import unlabelled_instances
from v3d_torch.odometry.depth_delay import DepthDelayCompensation
from v3d_torch.odometry.motion_estimator import MotionEstimator, RelativeMotion
from v3d_torch.odometry.odometry import Odometry, TrackedFrame
from v3d_torch.odometry.rolling_shutter import RollingShutterCompensation
from v3d_torch.runtime.input_checks import check_frame, check_instances, check_order, check_parts
from v3d_torch.runtime.stage_timer import StageTimer
from v3d_torch.segmentation import make_segmenter
from v3d_torch.tracking.camera_tracker import CameraTracker
from v3d_torch.tracking.map_tracker import MapTracker
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.tracking.pose_history import PoseHistory
from v3d_torch.types import RGBDFrame, Segmenter, TrackingStatus, memory_of


class V3DSLAM:
    """Tracks an RGB-D camera and maps what stands still.

    Every stage is an attribute, and any callable of the same signature can take its place. Those up to the features
    look at a frame by itself (`perceive`), and may run ahead of those that follow the camera (`take_in`).

    Args:
        camera: intrinsics; None takes those of the first frame.
        segment: gives the instances of a frame; None takes what the configuration names.
        config: of all stages.
        known: map of an earlier run, see `load_map`, in which the camera begins lost; None to begin a new one.

    Attributes:
        camera: of all frames; None before the first, where it was not given.
        outlooks: with which each of the next `PREFETCHED_FRAMES` frames is to be looked at, see `perceive`.

    Raises:
        WeightsError: the network's weights are not to be had.
        ConfigError: what is given as camera or configuration is none.
    """

    def __init__(
        self,
        camera: PinholeCamera | None = None,
        segment: Segmenter | None = None,
        config: Config | None = None,
        known: SparseMap | None = None,
    ) -> None:
        check_parts(camera, config)
        self.config = config or Config()
        self.segment = segment or make_segmenter(self.config.segmentation)
        self.poses = PoseHistory()
        self.timer = StageTimer()
        self._last: TrackedFrame | None = None
        self._memory: object = None
        self._known = known
        self.outlooks = [self.outlook()] * PREFETCHED_FRAMES
        self.camera: PinholeCamera | None = None
        if camera is not None:
            self._set_up(camera)

    def _set_up(self, camera: PinholeCamera) -> None:
        config, given = self.config, dict(vars(self))
        self.smooth_depth = DepthSmoother(config.depth.kernel_size, config.depth.sigma, config.depth.edge_ratio)
        self.detect_features = ORB(config.features, camera)
        self.back_project_instances = InstanceBackProjector(config.objects.clouds, camera)
        self.register = MotionEstimator(config.odometry, config.features, camera, config.seed)
        self.odometry = Odometry(config, camera, self.register)
        self.free_space_check = FreeSpaceCheck(config.objects.free_space, camera)
        self.propose_unlabelled = partial(
            unlabelled_instances, camera=camera, min_area=config.objects.free_space.min_unlabelled_area
        )
        self.classify_motion = MotionClassifier(config.objects, camera)
        self.compensate_rolling_shutter = RollingShutterCompensation(camera)
        self.compensate_depth_delay = DepthDelayCompensation(config, camera)
        self.map_tracker = MapTracker(config.tracking, config.features, camera)
        sparse_map = SparseMap.empty(config, camera) if self._known is None else self._known
        self.mapper = Mapper(config, camera, sparse_map)
        self.loop_closer = LoopCloser(config.loop, self.register, self.map_tracker, config.tracking.local_keyframes)
        for keyframe in self.mapper.map.active_keyframes:
            self.loop_closer.add_keyframe(keyframe)
        self.back_end = BackEnd(config, camera, self.mapper.map, self.loop_closer)
        self.track_camera = CameraTracker(
            self.map_tracker, self.loop_closer, self.mapper.map, config.tracking.local_keyframes
        )
        vars(self).update(given)  # a stage that the user put in place before the camera was known stays
        self.camera = camera

    def __call__(self, frame: RGBDFrame) -> FrameResult:
        """Take in the next frame.

        Raises:
            ConfigError: nobody said which camera took the first frame; a stage of the user's gave what it should not.
            InputError: it is no frame, or not of this camera, or not after the last one.
        """
        percept = self.preprocess(frame, self.outlooks[0])
        self.look_further()
        return self.track(percept)

    def outlook(self) -> PosePrediction | None:
        """How the camera is expected to go on; None in a known map as long as nobody knows where."""
        return self.poses.outlook() if self.poses.located or self._known is None else None

    def look_further(self) -> PosePrediction | None:
        """Note, before a frame is taken in, with which outlook the one `PREFETCHED_FRAMES` frames later is to be looked at."""
        self.outlooks = [*self.outlooks[1:], self.outlook()]
        return self.outlooks[-1]

    def preprocess(self, frame: RGBDFrame, outlook: PosePrediction | None) -> PreprocessedFrame:
        """Look at a frame by itself: nothing of what follows the camera is touched.

        Args:
            frame: the next one.
            outlook: how the camera was expected to go on `PREFETCHED_FRAMES` frames before, which tells up from down; see
                `FramePrefetcher`, which runs this ahead.

        Raises:
            ConfigError: nobody said which camera took the first frame; the segmenter gave no instances.
            InputError: it is no frame, or not of this camera.
        """
        camera = check_frame(frame, self.camera)
        if self.camera is None:
            self._set_up(camera)
        clock = StageTimer()
        with clock("segmentation"):  # III-A: instances, people among them set aside
            instances = self.segment(replace(frame, T_cw=None if outlook is None else outlook.at(frame.stamp)))
            check_instances(instances, frame)
        with clock("depth"):  # III-B.1: depth re-estimated
            depth = self.smooth_depth(frame.depth[None])[0]
        with clock("features"):  # III-A: ORB
            features = self.detect_features(frame.image, depth)
        return PreprocessedFrame(frame, instances, depth, features, clock.seconds, memory_of(self.segment))

    def track(self, percept: PreprocessedFrame) -> FrameResult:
        """Follow the camera and the objects on to the next frame.

        Raises:
            InputError: it is not after the last one.
        """
        check_order(percept.frame, self.poses.stamp)
        frame, instances, depth = percept.frame, percept.instances, percept.depth
        self._memory = percept.memory  # not as the segmentation has it now: it may be frames ahead
        self.timer.add(percept.seconds)
        with self.timer("motion"):  # III-E: the camera's motion since the last frame, seen on what stood still there
            last, outlook = self._last, self.poses.outlook()
            seen = TrackedFrame(frame, depth, self._at_once(percept.features, depth, frame, outlook.velocity))
            guess = outlook.at(frame.stamp) @ invert(outlook.T_cw)
            motion = None if last is None else self.odometry(last, seen, guess)
            T_cw = self._expect(frame.stamp, motion)
        with self.timer("background"):  # what does not fit that motion, also what the network has no name for
            view = self.free_space_check.make_view(frame.stamp, depth, T_cw)
            arrivals = self.free_space_check(view, trusted=motion is not None)
            if self.config.segmentation.source != "none":  # the baseline has no masks at all
                instances = instances.concatenate(self.propose_unlabelled(arrivals, instances, depth))
        with self.timer("clouds"):  # III-B.2: instances lifted to clean clouds
            clouds = self.back_project_instances(depth, instances)
        with self.timer("objects"):  # III-C, III-D: ids, Hough voting, Chamfer, the mask of what stands still
            scene = self.classify_motion(
                instances, clouds, view, arrivals, FeatureSupport(seen.features.pixel, seen.matched(motion))
            )
            keep = seen.features.in_mask(scene.static_mask)
        self.flush()  # III-E: bundle adjustment, loops, pose graph, begun with the frame before
        with self.timer("tracking"):  # III-E: the pose in the local map
            T_cw = self._expect(frame.stamp, motion)  # in the map as it is now
            velocity = outlook.velocity if motion is None else motion.velocity(frame.stamp - outlook.stamp)
            static = self._at_once(percept.features[keep], depth, frame, velocity)
            carried = seen.carried(motion, last)[keep]
            estimate = self.track_camera(static, depth, T_cw, carried, self.poses, moved=motion is not None)
        with self.timer("mapping"):  # keyframes and landmarks
            reference = self.track_camera.reference(estimate)
            T_new_old = self.poses.record(frame.stamp, estimate, reference, None if motion is None else motion.T_ba)
            if T_new_old is not None:
                self._move_world(T_new_old)
            self._look_back()
            keyframe = self.mapper(frame, static, estimate, reference)
            if estimate.status is not TrackingStatus.LOST:
                self.free_space_check.remember(view.moved_to(self.poses.T_cw))
            landmarks = estimate.landmarks if keyframe is None else keyframe.landmarks
            self._last = TrackedFrame(frame, depth, static, scene.static_mask, landmarks)
            if keyframe is not None:
                self.poses.anchor(keyframe)
                self.back_end.submit(keyframe)
        status = self.poses.statuses[-1]
        return FrameResult(**vars(scene), stamp=frame.stamp, T_wc=invert(self.poses.T_cw), status=status)

    def flush(self) -> None:
        """Take in what is being solved for the last keyframe. The next frame does that; after the last one, call it."""
        if self.camera is None or (solved := self.back_end.result()) is None:
            return
        self.timer.add(solved.seconds)
        with self.timer("mapping"):
            T_new_old = self.back_end.apply(solved)
            if T_new_old is not None:
                self._move_world(T_new_old)
            self.mapper.map.compact(self._landmarks_held())

    def _landmarks_held(self) -> list[Tensor]:
        """Ids of landmarks that are kept from frame to frame, outside the map."""
        seen = None if self._last is None else self._last.landmarks
        return [self.poses.landmarks] if seen is None else [self.poses.landmarks, seen]

    def _expect(self, stamp: float, motion: RelativeMotion | None) -> Tensor:
        """Pose of the camera by its motion since the last frame; predicted, where that is not known."""
        return self.poses.predict(stamp) if motion is None else rigid(motion.T_ba @ self.poses.T_cw)

    def _at_once(self, features: Features, depth: Tensor, frame: RGBDFrame, velocity: Tensor) -> Features:
        """Features as a camera would have seen them that takes all rows, of colour and of depth, at once."""
        features = self.compensate_depth_delay(features, depth, velocity, frame.depth_delay)
        return self.compensate_rolling_shutter(features, velocity, self.mapper.map.readout)

    def _look_back(self) -> None:
        """Put the last frame right: how the camera passed it, and so what it saw at once, is known only now."""
        sparse_map, last, velocity = self.mapper.map, self._last, self.poses.passed
        if velocity is None or last is None or last.landmarks is None or not sparse_map.keyframes:
            return
        newest = sparse_map.keyframes[-1]
        if newest.frame == last.frame.index:
            sparse_map.update_features(newest, self._at_once(newest.features, last.depth, last.frame, velocity))
        elif self.config.rolling_shutter.enabled:
            found, points = sparse_map.landmark_positions(last.landmarks)
            features = self._at_once(last.features[found], last.depth, last.frame, velocity)
            self.track_camera.again(features, points, self.poses)

    def _move_world(self, T_new_old: Tensor) -> None:
        """Carry what is remembered along when the world is corrected under it."""
        self.classify_motion.tracker.move_world(T_new_old)
        self.free_space_check.move_world(T_new_old)
