"""V3D-SLAM: the way of one frame, in the paper's order."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from v3d_torch.back_end import BackEnd
from v3d_torch.camera import PinholeCamera
from v3d_torch.config import Config
from v3d_torch.depth import DepthSmoother
from v3d_torch.intake import check_frame, check_instances, check_order, check_parts
from v3d_torch.lie import invert, rigid
from v3d_torch.localise import Localiser
from v3d_torch.loop.closing import LoopCloser
from v3d_torch.mapping.local_map import SparseMap
from v3d_torch.mapping.mapper import Mapper
from v3d_torch.mapping.recorder import Outlook, PoseRecorder, Status
from v3d_torch.objects.background import BackgroundWatch
from v3d_torch.objects.dynamics import ObjectDynamics
from v3d_torch.objects.lift import CloudLifter
from v3d_torch.objects.unnamed import unnamed_instances
from v3d_torch.objects.witnesses import Witnesses
from v3d_torch.odometry.late_depth import LateDepth
from v3d_torch.odometry.motion import Motion, MotionEstimator
from v3d_torch.odometry.odometry import Odometry, View
from v3d_torch.odometry.orb import ORB, Features
from v3d_torch.odometry.shutter import RollingShutter
from v3d_torch.odometry.tracker import MapTracker
from v3d_torch.percept import AHEAD, Percept, Tracked
from v3d_torch.segmentation import make_segmenter
from v3d_torch.timing import StageClock
from v3d_torch.types import RGBDFrame, Segmenter, memory_of


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
        outlooks: with which each of the next `AHEAD` frames is to be looked at, see `perceive`.

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
        self.poses = PoseRecorder()
        self.clock = StageClock()
        self._last: View | None = None
        self._memory: object = None
        self._known = known
        self.outlooks = [self.outlook()] * AHEAD
        self.camera: PinholeCamera | None = None
        if camera is not None:
            self._set_up(camera)

    def _set_up(self, camera: PinholeCamera) -> None:
        config, given = self.config, dict(vars(self))
        self.smooth = DepthSmoother(config.depth.kernel_size, config.depth.sigma, config.depth.edge)
        self.detect = ORB(config.features, camera)
        self.lift = CloudLifter(config.objects.clouds, camera)
        self.match = MotionEstimator(config.motion, config.features, camera, config.seed)
        self.move = Odometry(config, camera, self.match)
        self.watch = BackgroundWatch(config.objects.background, camera)
        self.propose = partial(unnamed_instances, camera=camera, min_area=config.objects.background.min_area)
        self.judge = ObjectDynamics(config.objects, camera)
        self.unroll = RollingShutter(camera)
        self.date_back = LateDepth(config, camera)
        self.track = MapTracker(config.tracking, config.features, camera)
        self.mapper = Mapper(config, camera, self._known)
        self.loops = LoopCloser(config.loop, self.match, self.track, config.tracking.local_keyframes)
        for keyframe in self.mapper.map.kept:
            self.loops.learn(keyframe)
        self.back_end = BackEnd(config, camera, self.mapper.map, self.loops)
        self.localise = Localiser(self.track, self.loops, self.mapper.map, config.tracking.local_keyframes)
        vars(self).update(given)  # a stage that the user put in place before the camera was known stays
        self.camera = camera

    def __call__(self, frame: RGBDFrame) -> Tracked:
        """Take in the next frame.

        Raises:
            ConfigError: nobody said which camera took the first frame; a stage of the user's gave what it should not.
            InputError: it is no frame, or not of this camera, or not after the last one.
        """
        percept = self.perceive(frame, self.outlooks[0])
        self.look_further()
        return self.take_in(percept)

    def outlook(self) -> Outlook | None:
        """How the camera is expected to go on; None in a known map as long as nobody knows where."""
        return self.poses.outlook() if self.poses.located or self._known is None else None

    def look_further(self) -> Outlook | None:
        """Note, before a frame is taken in, with which outlook the one `AHEAD` frames later is to be looked at."""
        self.outlooks = [*self.outlooks[1:], self.outlook()]
        return self.outlooks[-1]

    def perceive(self, frame: RGBDFrame, outlook: Outlook | None) -> Percept:
        """Look at a frame by itself: nothing of what follows the camera is touched.

        Args:
            frame: the next one.
            outlook: how the camera was expected to go on `AHEAD` frames before, which tells up from down; see
                `Lookahead`, which runs this ahead.

        Raises:
            ConfigError: nobody said which camera took the first frame; the segmenter gave no instances.
            InputError: it is no frame, or not of this camera.
        """
        camera = check_frame(frame, self.camera)
        if self.camera is None:
            self._set_up(camera)
        clock = StageClock()
        with clock("segmentation"):  # III-A: instances, people among them set aside
            instances = self.segment(replace(frame, T_cw=None if outlook is None else outlook.at(frame.stamp)))
            check_instances(instances, frame)
        with clock("depth"):  # III-B.1: depth re-estimated
            depth = self.smooth(frame.depth[None])[0]
        with clock("features"):  # III-A: ORB
            features = self.detect(frame.image, depth)
        return Percept(frame, instances, depth, features, clock.seconds, memory_of(self.segment))

    def take_in(self, percept: Percept) -> Tracked:
        """Follow the camera and the objects on to the next frame.

        Raises:
            InputError: it is not after the last one.
        """
        check_order(percept.frame, self.poses.stamp)
        frame, instances, depth = percept.frame, percept.instances, percept.depth
        self._memory = percept.memory  # not as the segmentation has it now: it may be frames ahead
        self.clock.add(percept.seconds)
        with self.clock("motion"):  # III-E: the camera's motion since the last frame, seen on what stood still there
            last, outlook = self._last, self.poses.outlook()
            seen = View(frame, depth, self._at_once(percept.features, depth, frame, outlook.velocity))
            guess = outlook.at(frame.stamp) @ invert(outlook.T_cw)
            motion = None if last is None else self.move(last, seen, guess)
            T_cw = self._expect(frame.stamp, motion)
        with self.clock("background"):  # what does not fit that motion, also what the network has no name for
            view = self.watch.look(frame.stamp, depth, T_cw)
            arrivals = self.watch(view, trusted=motion is not None)
            if self.config.segmentation.source != "none":  # the baseline has no masks at all
                instances = instances.joined(self.propose(arrivals, instances, depth))
        with self.clock("clouds"):  # III-B.2: instances lifted to clean clouds
            clouds = self.lift(depth, instances)
        with self.clock("objects"):  # III-C, III-D: ids, Hough voting, Chamfer, the mask of what stands still
            scene = self.judge(instances, clouds, view, arrivals, Witnesses(seen.features.pixel, seen.matched(motion)))
            keep = seen.features.on(scene.static)
        self.settle()  # III-E: bundle adjustment, loops, pose graph, begun with the frame before
        with self.clock("tracking"):  # III-E: the pose in the local map
            T_cw = self._expect(frame.stamp, motion)  # in the map as it is now
            velocity = outlook.velocity if motion is None else motion.velocity(frame.stamp - outlook.stamp)
            static = self._at_once(percept.features[keep], depth, frame, velocity)
            carried = seen.carried(motion, last)[keep]
            estimate = self.localise(static, depth, T_cw, carried, self.poses, moved=motion is not None)
        with self.clock("mapping"):  # keyframes and landmarks
            reference = self.localise.reference(estimate)
            T_new_old = self.poses.record(frame.stamp, estimate, reference, None if motion is None else motion.T_ba)
            if T_new_old is not None:
                self._move_world(T_new_old)
            self._look_back()
            keyframe = self.mapper(frame, static, estimate, reference)
            if estimate.status is not Status.LOST:
                self.watch.remember(view.at(self.poses.T_cw))
            landmarks = estimate.landmarks if keyframe is None else keyframe.landmarks
            self._last = View(frame, depth, static, scene.static, landmarks)
            if keyframe is not None:
                self.poses.anchor(keyframe)
                self.back_end.begin(keyframe)
        status = self.poses.statuses[-1]
        return Tracked(**vars(scene), stamp=frame.stamp, T_wc=invert(self.poses.T_cw), status=status)

    def settle(self) -> None:
        """Take in what is being solved for the last keyframe. The next frame does that; after the last one, call it."""
        if self.camera is None or (solved := self.back_end.result()) is None:
            return
        self.clock.add(solved.seconds)
        with self.clock("mapping"):
            T_new_old = self.back_end.take_in(solved)
            if T_new_old is not None:
                self._move_world(T_new_old)
            self.mapper.map.pack(self._landmarks_held())

    def _landmarks_held(self) -> list[Tensor]:
        """Ids of landmarks that are kept from frame to frame, outside the map."""
        seen = None if self._last is None else self._last.landmarks
        return [self.poses.landmarks] if seen is None else [self.poses.landmarks, seen]

    def _expect(self, stamp: float, motion: Motion | None) -> Tensor:
        """Pose of the camera by its motion since the last frame; predicted, where that is not known."""
        return self.poses.predict(stamp) if motion is None else rigid(motion.T_ba @ self.poses.T_cw)

    def _at_once(self, features: Features, depth: Tensor, frame: RGBDFrame, velocity: Tensor) -> Features:
        """Features as a camera would have seen them that takes all rows, of colour and of depth, at once."""
        features = self.date_back(features, depth, velocity, frame.delay)
        return self.unroll(features, velocity, self.mapper.map.readout)

    def _look_back(self) -> None:
        """Put the last frame right: how the camera passed it, and so what it saw at once, is known only now."""
        sparse_map, last, velocity = self.mapper.map, self._last, self.poses.passed
        if velocity is None or last is None or last.landmarks is None or not sparse_map.keyframes:
            return
        newest = sparse_map.keyframes[-1]
        if newest.frame == last.frame.index:
            sparse_map.see(newest, self._at_once(newest.features, last.depth, last.frame, velocity))
        elif self.config.shutter.enabled:
            found, points = sparse_map.behind(last.landmarks)
            features = self._at_once(last.features[found], last.depth, last.frame, velocity)
            self.localise.again(features, points, self.poses)

    def _move_world(self, T_new_old: Tensor) -> None:
        """Carry what is remembered along when the world is corrected under it."""
        self.judge.tracker.move_world(T_new_old)
        self.watch.move_world(T_new_old)
