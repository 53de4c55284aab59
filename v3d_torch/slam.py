"""V3D-SLAM: the way of one frame, in the paper's order."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import Config
from v3d_torch.depth import DepthSmoother
from v3d_torch.lie import rigid
from v3d_torch.loop.closing import LoopCloser
from v3d_torch.mapping.local_map import Keyframe, SparseMap
from v3d_torch.mapping.mapper import Mapper
from v3d_torch.mapping.recorder import Estimate, PoseRecorder, Status
from v3d_torch.objects.background import BackgroundWatch
from v3d_torch.objects.dynamics import ObjectDynamics, Scene
from v3d_torch.objects.lift import CloudLifter
from v3d_torch.objects.unnamed import unnamed_instances
from v3d_torch.objects.witnesses import Witnesses
from v3d_torch.odometry.motion import Motion, MotionEstimator
from v3d_torch.odometry.orb import ORB, Features
from v3d_torch.odometry.tracker import MapTracker
from v3d_torch.timing import StageClock
from v3d_torch.types import RGBDFrame, Segmenter


@dataclass(frozen=True)
class View:
    """What the last frame saw standing still: features, and the id of the landmark behind each, -1 for none."""

    stamp: float
    features: Features
    landmarks: Tensor


class V3DSLAM:
    """Tracks an RGB-D camera and maps what stands still.

    Args:
        camera: intrinsics.
        segment: gives the instances of a frame.
        config: of all stages.
        known: map of an earlier run, see `load_map`, in which the camera begins lost; None to begin a new one.
    """

    def __init__(
        self, camera: PinholeCamera, segment: Segmenter, config: Config | None = None, known: SparseMap | None = None
    ) -> None:
        self.config = config = config or Config()
        self.segment = segment
        self.smooth = DepthSmoother(config.depth.kernel_size, config.depth.sigma, config.depth.edge)
        self.detect = ORB(config.features, camera)
        self.lift = CloudLifter(config.objects.clouds, camera)
        self.motion = MotionEstimator(config.motion, config.features, camera, config.seed)
        self.watch = BackgroundWatch(config.objects.background, camera)
        self.propose = partial(unnamed_instances, camera=camera, min_area=config.objects.background.min_area)
        self.judge = ObjectDynamics(config.objects, camera)
        self.track = MapTracker(config.tracking, config.features, camera)
        self.mapper = Mapper(config, camera, known)
        self.loops = LoopCloser(config.loop, self.motion, self.track, config.tracking.local_keyframes)
        for keyframe in self.mapper.map.keyframes:
            self.loops.learn(keyframe)
        self.poses = PoseRecorder()
        self.clock = StageClock()
        self._last: View | None = None

    def __call__(self, frame: RGBDFrame) -> Scene:
        """Take in the next frame; its pose is then in ``poses``.

        Returns:
            What the object stage says of the frame.
        """
        predicted = self.poses.predict(frame.stamp)
        with self.clock("segmentation"):  # III-A: instances, people among them set aside
            placed = self.poses.located or not self.mapper.map.keyframes  # a known map does not tell where in it
            instances = self.segment(replace(frame, T_cw=predicted if placed else None))
        with self.clock("depth"):  # III-B.1: depth re-estimated
            depth = self.smooth(frame.depth[None])[0]
        with self.clock("features"):  # III-A: ORB
            features = self.detect(frame.image, depth)
        with self.clock("motion"):  # III-E: the camera's motion since the last frame, seen on what stood still there
            motion = self._move(frame.stamp, features)
            T_cw = predicted if motion is None else rigid(motion.T_ba @ self.poses.T_cw)
        with self.clock("background"):  # what does not fit that motion, also what the network has no name for
            view = self.watch.look(frame.stamp, depth, T_cw)
            arrivals = self.watch(view, trusted=motion is not None)
            if self.config.segmentation.source != "none":  # the baseline has no masks at all
                instances = instances.joined(self.propose(arrivals, instances, depth))
        with self.clock("clouds"):  # III-B.2: instances lifted to clean clouds
            clouds = self.lift(depth, instances)
        with self.clock("objects"):  # III-C, III-D: ids, Hough voting, Chamfer, the mask of what stands still
            scene = self.judge(instances, clouds, view, arrivals, self._witnesses(motion, features))
            keep = features.on(scene.static)
            static = features[keep]
        with self.clock("tracking"):  # III-E: the pose in the local map
            carried = self._carry(motion, len(features))[keep]
            estimate = self._localise(static, T_cw, carried, moved=motion is not None)
        with self.clock("mapping"):  # keyframes, landmarks, local bundle adjustment
            reference = self._reference(estimate)
            T_new_old = self.poses.record(frame.stamp, estimate, reference, None if motion is None else motion.T_ba)
            if T_new_old is not None:
                self._move_world(T_new_old)
            keyframe = self.mapper(frame, static, estimate, reference)
            if estimate.status is not Status.LOST:
                self.watch.remember(replace(view, T_cw=self.poses.T_cw))
            self._last = View(frame.stamp, static, estimate.landmarks if keyframe is None else keyframe.landmarks)
        if keyframe is not None:
            self.poses.anchor(keyframe)
            with self.clock("loop"):  # III-E: loop detection, pose graph
                T_new_old = self.loops.close(keyframe, self.mapper.map)
                if T_new_old is not None:
                    self._move_world(T_new_old)
        return scene

    def _move_world(self, T_new_old: Tensor) -> None:
        """Carry what is remembered along when the world is corrected under it."""
        self.judge.tracker.move_world(T_new_old)
        self.watch.move_world(T_new_old)

    def _move(self, stamp: float, features: Features) -> Motion | None:
        if self._last is None:
            return None
        return self.motion(self._last.features, features, elapsed=stamp - self._last.stamp)

    def _witnesses(self, motion: Motion | None, features: Features) -> Witnesses:
        """Which features fit the motion since the last frame; none where nobody knows it."""
        fits = torch.zeros(len(features), dtype=torch.bool)
        if motion is not None:
            fits[motion.pairs[:, 1]] = True
        return Witnesses(features.pixel, fits)

    def _carry(self, motion: Motion | None, count: int) -> Tensor:
        """Ids of the landmarks that the motion's matches carry over from the last frame, -1 for none, (count,)."""
        landmarks = torch.full((count,), -1, dtype=torch.int64)
        if motion is not None and self._last is not None:
            landmarks[motion.pairs[:, 1]] = self._last.landmarks[motion.pairs[:, 0]]
        return landmarks

    def _localise(self, static: Features, T_cw: Tensor, carried: Tensor, *, moved: bool) -> Estimate:
        """Pose in the local map, else in a place seen before, else by the motion alone, else lost."""
        if self.mapper.map.keyframes:
            local = self.mapper.map.local(self.poses.landmarks, self.config.tracking.local_keyframes)
            tracking = self.track(static, T_cw, local, carried)
            if tracking is None:
                place = self.loops.recognise(static, self.mapper.map)
                tracking = place.tracking if place is not None else None
            if tracking is not None:
                self.mapper.map.record(tracking)
                return Estimate(Status.TRACKED, tracking.T_cw, tracking.landmarks)
        known = moved and self.poses.status in (Status.TRACKED, Status.ODOMETRY)
        nothing = torch.full((len(static),), -1, dtype=torch.int64)
        return Estimate(Status.ODOMETRY if known else Status.LOST, T_cw, nothing)

    def _reference(self, estimate: Estimate) -> Keyframe | None:
        """The keyframe that shares most with the frame, else the last one."""
        keyframes = self.mapper.map.keyframes
        best = self.mapper.map.covisible(estimate.landmarks[estimate.landmarks >= 0], 1)
        return keyframes[int(best[0])] if len(best) else (keyframes[-1] if keyframes else None)
